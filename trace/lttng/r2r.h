/* SPDX-License-Identifier: MIT OR Apache-2.0
 *
 * The provider `r2r`: the events of r2r's executor, of which the sampler is ours.
 */
#undef LTTNG_UST_TRACEPOINT_PROVIDER
#define LTTNG_UST_TRACEPOINT_PROVIDER r2r
#undef LTTNG_UST_TRACEPOINT_INCLUDE
#define LTTNG_UST_TRACEPOINT_INCLUDE "r2r.h"

#if !defined(TAUT_TRACE_R2R_H) || defined(LTTNG_UST_TRACEPOINT_HEADER_MULTI_READ)
#define TAUT_TRACE_R2R_H

#include <lttng/tracepoint.h>
#include <stddef.h>
#include <stdint.h>

LTTNG_UST_TRACEPOINT_EVENT(r2r, spin_start,
	LTTNG_UST_TP_ARGS(size_t, node, uint64_t, seconds, uint32_t, nanoseconds),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(size_t, node_handle, node)
		lttng_ust_field_integer(uint64_t, timeout_s, seconds)
		lttng_ust_field_integer(uint32_t, timeout_ns, nanoseconds)))

LTTNG_UST_TRACEPOINT_EVENT(r2r, spin_end,
	LTTNG_UST_TP_ARGS(size_t, node),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(size_t, node_handle, node)))

LTTNG_UST_TRACEPOINT_EVENT(r2r, spin_wake,
	LTTNG_UST_TP_ARGS(size_t, node),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(size_t, node_handle, node)))

LTTNG_UST_TRACEPOINT_EVENT(r2r, spin_timeout,
	LTTNG_UST_TP_ARGS(size_t, node),
	LTTNG_UST_TP_FIELDS(
		lttng_ust_field_integer_hex(size_t, node_handle, node)))

#endif

#include <lttng/tracepoint-event.h>
