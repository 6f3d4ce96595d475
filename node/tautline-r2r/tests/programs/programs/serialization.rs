// SPDX-License-Identifier: MIT OR Apache-2.0
//! From a message to bytes, from bytes to JSON, and back.

use r2r::{WrappedNativeMsgUntyped, WrappedTypesupport};

fn round_trip<T: WrappedTypesupport + PartialEq + 'static>(msg: &T) -> r2r::Result<T> {
    let copy = T::from_serialized_bytes(&msg.to_serialized_bytes()?)?;
    assert_eq!(&copy, msg);
    Ok(copy)
}

pub fn main() -> Result<(), Box<dyn std::error::Error>> {
    let msg = r2r::std_msgs::msg::String { data: "Hello, world".into() };
    let bytes = msg.to_serialized_bytes()?;

    let mut native = WrappedNativeMsgUntyped::new_from("std_msgs/msg/String")?;
    native.from_serialized_bytes(&bytes)?;
    let json = native.to_json()?;
    assert_eq!(json, serde_json::json!({ "data": "Hello, world" }));
    let empty = WrappedNativeMsgUntyped::new_from("std_msgs/msg/String")?;
    empty.from_json(json.clone())?;
    assert_eq!(empty.to_json()?, json);
    assert!(WrappedNativeMsgUntyped::new_from("std_msgs/msg/None").is_err());

    let msg2 = r2r::std_msgs::msg::String::from_serialized_bytes(&bytes)?;
    let msg3: r2r::std_msgs::msg::String = serde_json::from_value(json)?;
    assert_eq!(msg, msg2);
    assert_eq!(msg2, msg3);
    round_trip(&r2r::geometry_msgs::msg::Twist::default())?;
    assert!(r2r::std_msgs::msg::String::from_serialized_bytes(&bytes[..6]).is_err());
    Ok(())
}
