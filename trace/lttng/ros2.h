/* SPDX-License-Identifier: MIT OR Apache-2.0
 *
 * The provider `ros2`: names, fields and types of ros2_tracing 8.4, whose tools read them. A handle, in ROS 2 an address, is
 * the number of an object within its process.
 */
#undef LTTNG_UST_TRACEPOINT_PROVIDER
#define LTTNG_UST_TRACEPOINT_PROVIDER ros2
#undef LTTNG_UST_TRACEPOINT_INCLUDE
#define LTTNG_UST_TRACEPOINT_INCLUDE "ros2.h"

#if !defined(TAUT_TRACE_ROS2_H) || defined(LTTNG_UST_TRACEPOINT_HEADER_MULTI_READ)
#define TAUT_TRACE_ROS2_H

#include <lttng/tracepoint.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* What ros2_tracing keeps of a gid. */
#define TAUT_GID_BYTES 24

LTTNG_UST_TRACEPOINT_EVENT(ros2, rcl_init,
	LTTNG_UST_TP_ARGS(const void *, context, const char *, release),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, context_handle, context)
		lttng_ust_field_string(version, release)))

LTTNG_UST_TRACEPOINT_EVENT(ros2, rcl_node_init,
	LTTNG_UST_TP_ARGS(const void *, node, const void *, rmw, const char *, name, const char *, space),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, node_handle, node)
		lttng_ust_field_integer_hex(const void *, rmw_handle, rmw)
		lttng_ust_field_string(node_name, name)
		lttng_ust_field_string(namespace, space)))

LTTNG_UST_TRACEPOINT_EVENT(ros2, rmw_publisher_init,
	LTTNG_UST_TP_ARGS(const void *, rmw, const uint8_t *, id),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, rmw_publisher_handle, rmw)
		lttng_ust_field_array(uint8_t, gid, id, TAUT_GID_BYTES)))

LTTNG_UST_TRACEPOINT_EVENT(ros2, rcl_publisher_init,
	LTTNG_UST_TP_ARGS(const void *, publisher, const void *, node, const void *, rmw, const char *, topic, size_t, depth),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, publisher_handle, publisher)
		lttng_ust_field_integer_hex(const void *, node_handle, node)
		lttng_ust_field_integer_hex(const void *, rmw_publisher_handle, rmw)
		lttng_ust_field_string(topic_name, topic)
		lttng_ust_field_integer(size_t, queue_depth, depth)))

LTTNG_UST_TRACEPOINT_EVENT(ros2, rclcpp_publish,
	LTTNG_UST_TP_ARGS(const void *, body),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, message, body)))

LTTNG_UST_TRACEPOINT_EVENT(ros2, rcl_publish,
	LTTNG_UST_TP_ARGS(const void *, publisher, const void *, body),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, publisher_handle, publisher)
		lttng_ust_field_integer_hex(const void *, message, body)))

LTTNG_UST_TRACEPOINT_EVENT(ros2, rmw_publish,
	LTTNG_UST_TP_ARGS(const void *, rmw, const void *, body, int64_t, published_ns),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, rmw_publisher_handle, rmw)
		lttng_ust_field_integer_hex(const void *, message, body)
		lttng_ust_field_integer(int64_t, timestamp, published_ns)))

LTTNG_UST_TRACEPOINT_EVENT(ros2, rmw_subscription_init,
	LTTNG_UST_TP_ARGS(const void *, rmw, const uint8_t *, id),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, rmw_subscription_handle, rmw)
		lttng_ust_field_array(uint8_t, gid, id, TAUT_GID_BYTES)))

LTTNG_UST_TRACEPOINT_EVENT(ros2, rcl_subscription_init,
	LTTNG_UST_TP_ARGS(const void *, handle, const void *, node, const void *, rmw, const char *, topic, size_t, depth),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, subscription_handle, handle)
		lttng_ust_field_integer_hex(const void *, node_handle, node)
		lttng_ust_field_integer_hex(const void *, rmw_subscription_handle, rmw)
		lttng_ust_field_string(topic_name, topic)
		lttng_ust_field_integer(size_t, queue_depth, depth)))

LTTNG_UST_TRACEPOINT_EVENT(ros2, rclcpp_subscription_init,
	LTTNG_UST_TP_ARGS(const void *, handle, const void *, object),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, subscription_handle, handle)
		lttng_ust_field_integer_hex(const void *, subscription, object)))

LTTNG_UST_TRACEPOINT_EVENT(ros2, rclcpp_subscription_callback_added,
	LTTNG_UST_TP_ARGS(const void *, object, const void *, function),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, subscription, object)
		lttng_ust_field_integer_hex(const void *, callback, function)))

LTTNG_UST_TRACEPOINT_EVENT(ros2, rmw_take,
	LTTNG_UST_TP_ARGS(const void *, rmw, const void *, body, int64_t, published_ns, bool, success),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, rmw_subscription_handle, rmw)
		lttng_ust_field_integer_hex(const void *, message, body)
		lttng_ust_field_integer(int64_t, source_timestamp, published_ns)
		lttng_ust_field_integer(int, taken, success ? 1 : 0)))

LTTNG_UST_TRACEPOINT_EVENT(ros2, rcl_take,
	LTTNG_UST_TP_ARGS(const void *, body),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, message, body)))

LTTNG_UST_TRACEPOINT_EVENT(ros2, rclcpp_take,
	LTTNG_UST_TP_ARGS(const void *, body),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, message, body)))

LTTNG_UST_TRACEPOINT_EVENT(ros2, rcl_timer_init,
	LTTNG_UST_TP_ARGS(const void *, timer, int64_t, period_ns),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, timer_handle, timer)
		lttng_ust_field_integer(int64_t, period, period_ns)))

LTTNG_UST_TRACEPOINT_EVENT(ros2, rclcpp_timer_callback_added,
	LTTNG_UST_TP_ARGS(const void *, timer, const void *, function),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, timer_handle, timer)
		lttng_ust_field_integer_hex(const void *, callback, function)))

LTTNG_UST_TRACEPOINT_EVENT(ros2, rclcpp_timer_link_node,
	LTTNG_UST_TP_ARGS(const void *, timer, const void *, node),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, timer_handle, timer)
		lttng_ust_field_integer_hex(const void *, node_handle, node)))

LTTNG_UST_TRACEPOINT_EVENT(ros2, rclcpp_callback_register,
	LTTNG_UST_TP_ARGS(const void *, function, const char *, name),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, callback, function)
		lttng_ust_field_string(symbol, name)))

LTTNG_UST_TRACEPOINT_EVENT(ros2, callback_start,
	LTTNG_UST_TP_ARGS(const void *, function, bool, intra),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, callback, function)
		lttng_ust_field_integer(int, is_intra_process, intra ? 1 : 0)))

LTTNG_UST_TRACEPOINT_EVENT(ros2, callback_end,
	LTTNG_UST_TP_ARGS(const void *, function),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(const void *, callback, function)))

#endif

#include <lttng/tracepoint-event.h>
