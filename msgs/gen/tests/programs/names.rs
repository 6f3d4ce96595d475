// SPDX-License-Identifier: MIT OR Apache-2.0
//! Uses messages whose names Rust or the generated code uses, too.
#![deny(warnings)]

include!("packages.rs");

use name_msgs::msg;
use tautline_msgs::Message;

/// Writes a message, and reads it in place and as an owned one.
fn through<M: Message + Default + PartialEq + std::fmt::Debug>(message: &M) {
    let bytes = message.to_cdr().unwrap();
    assert_eq!(&M::from_cdr(&bytes).unwrap(), message);
}

fn main() {
    let mut option = msg::Option::default();
    (option.gen_, option.self_, option.to_owned_) = (1, 2, 3);
    option.type_ = "t".to_owned();
    through(&option);
    through(&msg::Vec { some: vec![option.clone(); 2], none: option.clone(), ok: 3 });
    through(&msg::Box { me: std::array::from_fn(|_| msg::Self_::default()), ..Default::default() });
    through(&msg::Message::default());
    through(&name_msgs::srv::Self_::Request::default());
    through(&name_msgs::action::Box::Result::default());
    let json = serde_json::to_string(&option).unwrap();
    assert!(json.starts_with(r#"{"gen":1,"self":2,"type":"t","crate":"","to_owned":3,"default_rest":[],"#), "{json}");
    assert_eq!(msg::Self_::TYPE_NAME, "name_msgs/msg/Self");

    use ref_msgs::msg::{Map, MapRef, MapRef_, MapRefRef_, MapSizes_, MapWriterWriter};
    through(&async_::msg::Maps { maps: vec![Map::default()], one: Map { id: "x".to_owned(), parts: vec![MapRef::default()] } });
    fn view<'a>(maps: async_::msg::MapsRef<'a>) -> MapRef_<'a> {
        maps.one()
    }
    let _ = (view, MapSizes_::default(), |part: MapRefRef_<'_>, _: MapWriterWriter<'_, '_>| part.to_owned());
}
