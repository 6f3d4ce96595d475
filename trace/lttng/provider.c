/* SPDX-License-Identifier: MIT OR Apache-2.0
 *
 * The tracepoints of ros2.h and r2r.h as functions, which lttng.rs calls.
 */
#define LTTNG_UST_TRACEPOINT_CREATE_PROBES
#define LTTNG_UST_TRACEPOINT_DEFINE
#include "ros2.h"
#include "r2r.h"

#define HANDLE(number) ((const void *)(uintptr_t)(number))

/*
 * LTTng finds the tracepoints through the section of pointers to them, by its start and stop symbols only. Linkers that
 * collect garbage (lld, which rustc uses, and ld.bfd with -z start-stop-gc) see no reference and drop the section: then no
 * event is ever recorded, without a word. Constructors are kept, and with them what they refer to: one pointer keeps the
 * section of this file, which holds them all.
 */
__attribute__((constructor)) static void keep_the_tracepoints(void)
{
	__asm__ volatile("" : : "r"(&lttng_ust_tracepoint_ptr_ros2___callback_start));
}

void taut_lttng_context_init(uint64_t context, const char *release)
{
	lttng_ust_tracepoint(ros2, rcl_init, HANDLE(context), release);
}

void taut_lttng_node_init(uint64_t node, const char *name, const char *space)
{
	lttng_ust_tracepoint(ros2, rcl_node_init, HANDLE(node), HANDLE(node), name, space);
}

void taut_lttng_publisher_init(uint64_t publisher, uint64_t node, const char *topic, size_t depth, const uint8_t *gid)
{
	lttng_ust_tracepoint(ros2, rmw_publisher_init, HANDLE(publisher), gid);
	lttng_ust_tracepoint(ros2, rcl_publisher_init, HANDLE(publisher), HANDLE(node), HANDLE(publisher), topic, depth);
}

void taut_lttng_subscription_init(uint64_t handle, uint64_t node, const char *topic, size_t depth, const uint8_t *gid)
{
	lttng_ust_tracepoint(ros2, rmw_subscription_init, HANDLE(handle), gid);
	lttng_ust_tracepoint(ros2, rcl_subscription_init, HANDLE(handle), HANDLE(node), HANDLE(handle), topic, depth);
	lttng_ust_tracepoint(ros2, rclcpp_subscription_init, HANDLE(handle), HANDLE(handle));
}

void taut_lttng_subscription_callback_init(uint64_t subscription, uint64_t callback, const char *name)
{
	lttng_ust_tracepoint(ros2, rclcpp_subscription_callback_added, HANDLE(subscription), HANDLE(callback));
	lttng_ust_tracepoint(ros2, rclcpp_callback_register, HANDLE(callback), name);
}

void taut_lttng_timer_init(uint64_t timer, uint64_t node, int64_t period_ns)
{
	lttng_ust_tracepoint(ros2, rcl_timer_init, HANDLE(timer), period_ns);
	if (node != 0)
		lttng_ust_tracepoint(ros2, rclcpp_timer_link_node, HANDLE(timer), HANDLE(node));
}

void taut_lttng_timer_callback_init(uint64_t timer, uint64_t callback, const char *name)
{
	lttng_ust_tracepoint(ros2, rclcpp_timer_callback_added, HANDLE(timer), HANDLE(callback));
	lttng_ust_tracepoint(ros2, rclcpp_callback_register, HANDLE(callback), name);
}

void taut_lttng_publish(uint64_t publisher, const void *message, int64_t timestamp_ns)
{
	lttng_ust_tracepoint(ros2, rclcpp_publish, message);
	lttng_ust_tracepoint(ros2, rcl_publish, HANDLE(publisher), message);
	lttng_ust_tracepoint(ros2, rmw_publish, HANDLE(publisher), message, timestamp_ns);
}

void taut_lttng_take(uint64_t subscription, const void *message, int64_t source_timestamp_ns)
{
	lttng_ust_tracepoint(ros2, rmw_take, HANDLE(subscription), message, source_timestamp_ns, true);
	lttng_ust_tracepoint(ros2, rcl_take, message);
	lttng_ust_tracepoint(ros2, rclcpp_take, message);
}

void taut_lttng_callback_start(uint64_t callback)
{
	lttng_ust_tracepoint(ros2, callback_start, HANDLE(callback), false);
}

void taut_lttng_callback_end(uint64_t callback)
{
	lttng_ust_tracepoint(ros2, callback_end, HANDLE(callback));
}

void taut_lttng_spin_start(uint64_t node, uint64_t timeout_s, uint32_t timeout_ns)
{
	lttng_ust_tracepoint(r2r, spin_start, node, timeout_s, timeout_ns);
}

void taut_lttng_spin_wake(uint64_t node)
{
	lttng_ust_tracepoint(r2r, spin_wake, node);
}

void taut_lttng_spin_timeout(uint64_t node)
{
	lttng_ust_tracepoint(r2r, spin_timeout, node);
}

void taut_lttng_spin_end(uint64_t node)
{
	lttng_ust_tracepoint(r2r, spin_end, node);
}
