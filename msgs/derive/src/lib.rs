// SPDX-License-Identifier: MIT OR Apache-2.0
//! The derive macro behind `tautline-msgs`; its documentation is at the re-export there.
#![forbid(unsafe_code)]

mod attributes;
mod enums;
mod structs;

use proc_macro2::TokenStream;
use syn::{Data, DeriveInput, Error, Result, parse_macro_input};

use attributes::{Attributes, Repr};

/// Derives `Plain`, and `Message` for a struct with a name. See `tautline_msgs::Message`.
#[proc_macro_derive(Message, attributes(message))]
pub fn derive_message(input: proc_macro::TokenStream) -> proc_macro::TokenStream {
    let input = parse_macro_input!(input as DeriveInput);
    expand(&input).unwrap_or_else(Error::into_compile_error).into()
}

fn expand(input: &DeriveInput) -> Result<TokenStream> {
    if let Some(parameter) = input.generics.params.first() {
        return Err(Error::new_spanned(
            parameter,
            "a message has one fixed layout: remove the generic parameters and lifetimes",
        ));
    }
    let attributes = Attributes::parse(input)?;
    let repr = Repr::parse(input)?;
    match &input.data {
        Data::Struct(data) => structs::expand(input, data, &attributes, &repr),
        Data::Enum(data) => enums::expand(input, data, &attributes, &repr),
        Data::Union(data) => Err(Error::new_spanned(
            data.union_token,
            "a union does not say which of its fields is valid: use a `#[repr(C)]` struct",
        )),
    }
}
