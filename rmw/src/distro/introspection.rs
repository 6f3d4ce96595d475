// SPDX-License-Identifier: MIT OR Apache-2.0
//! Descriptions of types whose type supports have none, from the members of their structs.

use crate::bindings::*;
use std::collections::BTreeMap;
use std::ffi::{CStr, c_char};
use tautline_schema::{FieldDescription, FieldTypeDescription, IndividualTypeDescription, TypeDescription};

type Message = rosidl_typesupport_introspection_c__MessageMembers;
type Service = rosidl_typesupport_introspection_c__ServiceMembers;
type Types = BTreeMap<String, IndividualTypeDescription>;

/// The structs of C and of C++ are the same.
pub(crate) const SUPPORTS: [&CStr; 2] =
    [c"rosidl_typesupport_introspection_c", c"rosidl_typesupport_introspection_cpp"];

// Of `type_description_interfaces/msg/FieldType`.
const NESTED: u8 = 1;
const TIME: &str = "builtin_interfaces/msg/Time";
const INFO: &str = "service_msgs/msg/ServiceEventInfo";
const INT32: u8 = 6;
const UINT8: u8 = 3;
const UINT32: u8 = 7;
const INT64: u8 = 8;
const ARRAY: u8 = 48;
const BOUNDED: u8 = 96;
const UNBOUNDED: u8 = 144;
/// Added to the number of a string type if it is bounded; see `WITH_BOUND`.
const STRING: u8 = 17;
const WSTRING: u8 = 18;
const WITH_BOUND: u8 = 4;
/// Indexed by introspection's number of a primitive, from 1: float, double, long double, char, wchar, bool, octet, and integers.
const PRIMITIVES: [u8; 15] = [10, 11, 12, 13, 14, 15, 16, 3, 2, 5, 4, 7, 6, 9, 8];

/// Returns `std_msgs/msg/Bool` for `std_msgs__msg`, or `std_msgs::msg`, and `Bool`.
///
/// # Safety
/// Both are texts.
pub(crate) unsafe fn name(namespace: *const c_char, name: *const c_char) -> String {
    // SAFETY: the caller's contract.
    let [namespace, name] = [namespace, name].map(|text| unsafe { CStr::from_ptr(text) }.to_string_lossy());
    format!("{}/{name}", namespace.replace("__", "/").replace("::", "/"))
}

/// # Safety
/// The members come from their generator.
pub(crate) unsafe fn message(members: &Message) -> TypeDescription {
    let mut types = Types::new();
    // SAFETY: the caller's contract.
    let name = unsafe { visit(members, &mut types) };
    described(name, types)
}

/// The description of a service, with the event message that ROS derives from it.
///
/// # Safety
/// As [`message`].
pub(crate) unsafe fn service(members: &Service) -> TypeDescription {
    let mut types = Types::new();
    // SAFETY: the caller's contract: a service has both messages.
    let (name, request, response) = unsafe {
        let name = name(members.service_namespace_, members.service_name_);
        (name, visit(&*members.request_members_, &mut types), visit(&*members.response_members_, &mut types))
    };
    let event = format!("{name}_Event");
    let mut add = |name: &str, fields: Vec<FieldDescription>| {
        types.insert(name.to_owned(), IndividualTypeDescription { type_name: name.to_owned(), fields });
    };
    add(TIME, vec![field("sec", INT32, 0, ""), field("nanosec", UINT32, 0, "")]);
    add(
        INFO,
        vec![
            field("event_type", UINT8, 0, ""),
            field("stamp", NESTED, 0, TIME),
            field("client_gid", ARRAY + UINT8, 16, ""),
            field("sequence_number", INT64, 0, ""),
        ],
    );
    add(
        &event,
        vec![
            field("info", NESTED, 0, INFO),
            field("request", BOUNDED + NESTED, 1, &request),
            field("response", BOUNDED + NESTED, 1, &response),
        ],
    );
    add(
        &name,
        vec![
            field("request_message", NESTED, 0, &request),
            field("response_message", NESTED, 0, &response),
            field("event_message", NESTED, 0, &event),
        ],
    );
    described(name, types)
}

fn described(name: String, mut types: Types) -> TypeDescription {
    let empty = IndividualTypeDescription { type_name: name.clone(), fields: Vec::new() };
    TypeDescription {
        type_description: types.remove(&name).unwrap_or(empty),
        referenced_type_descriptions: types.into_values().collect(),
    }
}

fn field(name: &str, type_id: u8, capacity: u64, nested: &str) -> FieldDescription {
    let nested_type_name = nested.to_owned();
    let ty = FieldTypeDescription { type_id, capacity, string_capacity: 0, nested_type_name };
    FieldDescription { name: name.to_owned(), ty, default_value: String::new() }
}

/// Adds a message and its nested messages. Returns its name.
///
/// # Safety
/// As [`message`].
unsafe fn visit(members: &Message, types: &mut Types) -> String {
    // SAFETY: the caller's contract.
    let type_name = unsafe { name(members.message_namespace_, members.message_name_) };
    if types.contains_key(&type_name) {
        return type_name;
    }
    let count = members.member_count_ as usize;
    // SAFETY: the caller's contract: so many.
    let members = unsafe { std::slice::from_raw_parts(members.members_, count) };
    let fields = members.iter().map(|member| {
        let bound = member.string_upper_bound_;
        let string = |id| if bound == 0 { id } else { id + WITH_BOUND };
        let base = match member.type_id_ {
            id @ 1..=15 => PRIMITIVES[id as usize - 1],
            16 => string(STRING),
            17 => string(WSTRING),
            18 => NESTED,
            // Not a type that has a number: it is refused.
            _ => 0,
        };
        let shape = match (member.is_array_, member.array_size_, member.is_upper_bound_) {
            (false, ..) => 0,
            (true, 0, _) => UNBOUNDED,
            (true, _, true) => BOUNDED,
            (true, _, false) => ARRAY,
        };
        let capacity = if member.is_array_ { member.array_size_ as u64 } else { 0 };
        // SAFETY: the caller's contract: a text, and members if it is a message.
        let (name, nested) = unsafe {
            let nested = member.members_.as_ref().map(|support| &*support.data.cast::<Message>());
            let nested = nested.filter(|_| base == NESTED).map(|nested| visit(nested, types));
            (CStr::from_ptr(member.name_).to_string_lossy(), nested.unwrap_or_default())
        };
        let mut field = field(&name, base + shape, capacity, &nested);
        field.ty.string_capacity = bound as u64;
        field
    });
    let fields = fields.collect();
    types.insert(type_name.clone(), IndividualTypeDescription { type_name: type_name.clone(), fields });
    type_name
}
