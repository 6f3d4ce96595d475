// SPDX-License-Identifier: MIT OR Apache-2.0
//! Functions for which rmw permits RMW_RET_UNSUPPORTED: preallocation for bounded messages, sizes of future messages, content
//! filters, dynamic messages, network flows, endpoints of services (from Lyrical on).

use crate::bindings::*;
use crate::error::{Error, answer};
use std::ffi::{c_char, c_void};

/// Functions that return this for any arguments.
macro_rules! unsupported {
    ($($name:ident($($argument:ty),*): $reason:literal;)*) => {$(
        #[unsafe(no_mangle)]
        #[doc = concat!("Unsupported: ", $reason, ".")]
        pub extern "C" fn $name($(_: $argument),*) -> rmw_ret_t {
            answer(|| Err(Error::unsupported(concat!(stringify!($name), ": ", $reason))))
        }
    )*};
}

type TypeSupport = *const rosidl_message_type_support_t;
type Bounds = *const rosidl_runtime_c__Sequence__bound;
type PublisherAllocation = *mut rmw_publisher_allocation_t;
type SubscriptionAllocation = *mut rmw_subscription_allocation_t;
/// `rosidl_dynamic_typesupport_dynamic_data_t` and similar, which are not accessed, and not all distributions have.
type Opaque = *mut c_void;

unsupported! {
    rmw_init_publisher_allocation(TypeSupport, Bounds, PublisherAllocation): "a publisher has its own memory";
    rmw_fini_publisher_allocation(PublisherAllocation): "a publisher has its own memory";
    rmw_init_subscription_allocation(TypeSupport, Bounds, SubscriptionAllocation): "a subscription needs no memory";
    rmw_fini_subscription_allocation(SubscriptionAllocation): "a subscription needs no memory";
    rmw_get_serialized_message_size(TypeSupport, Bounds, *mut usize): "sizes follow from messages";
    rmw_subscription_set_content_filter(*mut rmw_subscription_t, *const rmw_subscription_content_filter_options_t): "there are no content filters: rcl filters where it can";
    rmw_subscription_get_content_filter(*const rmw_subscription_t, *mut rcutils_allocator_t, *mut rmw_subscription_content_filter_options_t): "there are no content filters";
    rmw_take_dynamic_message(*const rmw_subscription_t, Opaque, *mut bool, SubscriptionAllocation): "there are no dynamic messages";
    rmw_take_dynamic_message_with_info(*const rmw_subscription_t, Opaque, *mut bool, *mut rmw_message_info_t, SubscriptionAllocation): "there are no dynamic messages";
    rmw_serialization_support_init(*const c_char, *mut rcutils_allocator_t, Opaque): "there are no dynamic messages";
    rmw_publisher_get_network_flow_endpoints(*const rmw_publisher_t, *mut rcutils_allocator_t, Opaque): "there is no network flow in shared memory";
    rmw_subscription_get_network_flow_endpoints(*const rmw_subscription_t, *mut rcutils_allocator_t, Opaque): "there is no network flow in shared memory";
    rmw_get_clients_info_by_service(*const rmw_node_t, *mut rcutils_allocator_t, *const c_char, bool, Opaque): "there is no information on a service's endpoints";
    rmw_get_servers_info_by_service(*const rmw_node_t, *mut rcutils_allocator_t, *const c_char, bool, Opaque): "there is no information on a service's endpoints";
}
