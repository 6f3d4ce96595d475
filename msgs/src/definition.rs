// SPDX-License-Identifier: MIT OR Apache-2.0

/// A type's definition as generated code contains it: its own text, and references to the definitions of its
/// fields' types.
#[derive(Debug, PartialEq, Eq)]
pub struct Definition {
    /// `package/msg/Name`.
    pub type_name: &'static str,
    /// The lines of its `.msg` file, normalised, without comments.
    pub text: &'static str,
    /// The definitions of its fields' types.
    pub nested: &'static [&'static Definition],
}

impl Definition {
    /// The text in the form of bags (`ros2msg`): the type's own lines, then those of each type that it needs, in order of
    /// their names, each after a line of `=` and a line `MSG: package/Name`.
    ///
    /// # Real-time
    /// Setup only: allocates.
    pub fn to_text(&self) -> String {
        let mut needed = Vec::new();
        self.collect(&mut needed);
        needed.sort_by_key(|definition| definition.type_name);
        let mut text = self.text.to_owned();
        for definition in needed {
            text.push_str(&"=".repeat(80));
            text.push_str("\nMSG: ");
            text.push_str(&definition.type_name.replacen("/msg/", "/", 1));
            text.push('\n');
            text.push_str(definition.text);
        }
        text
    }

    fn collect(&self, found: &mut Vec<&'static Definition>) {
        for nested in self.nested {
            if !found.iter().any(|known| known.type_name == nested.type_name) {
                found.push(nested);
                nested.collect(found);
            }
        }
    }
}

/// The definition of a generated type, for types that have a field of it.
#[doc(hidden)]
pub const fn definition_of<T: crate::Message>() -> &'static Definition {
    match T::DEFINITION {
        Some(definition) => definition,
        None => panic!("the type of a generated message's field is generated as well"),
    }
}
