// SPDX-License-Identifier: MIT OR Apache-2.0
//! Field-less enums: written as the integer of their `repr`.

use proc_macro2::TokenStream;
use quote::{format_ident, quote, quote_spanned};
use syn::{DataEnum, DeriveInput, Error, Fields, Result};

use crate::attributes::{Attributes, Repr};

const INTEGERS: [&str; 6] = ["u8", "i8", "u16", "i16", "u32", "i32"];

pub fn expand(
    input: &DeriveInput,
    data: &DataEnum,
    attributes: &Attributes,
    repr: &Repr,
) -> Result<TokenStream> {
    let name = &input.ident;
    if let Some(given) = &attributes.name {
        return Err(Error::new_spanned(
            given,
            "an enum is a field of messages, no message itself: remove the name, or wrap the enum in a struct",
        ));
    }
    let Some(integer) = INTEGERS.into_iter().find(|integer| repr.has(integer)) else {
        return Err(Error::new_spanned(
            name,
            format!("the size of enum `{name}` is not stated: add `#[repr(u8)]` (or i8, u16, i16, u32, i32)"),
        ));
    };
    if repr.has("C") {
        return Err(Error::new_spanned(
            name,
            format!("write `#[repr({integer})]` alone on enum `{name}`, without `C`"),
        ));
    }
    if let Some(variant) = data.variants.iter().find(|variant| !matches!(variant.fields, Fields::Unit)) {
        return Err(Error::new_spanned(
            variant,
            "a variant with fields has no CDR: use a struct with an enum that says which field is meant",
        ));
    }
    let variants: Vec<_> = data.variants.iter().map(|variant| &variant.ident).collect();
    let integer = format_ident!("{integer}");
    let krate = &attributes.krate;
    let zero = format!(
        "enum `{name}` needs a variant of value 0, because a loan starts as zeroed memory: add `Unknown = 0`, or let \
         one of its variants be 0"
    );
    let proof = quote_spanned! {name.span()=>
        const _: () = ::core::assert!(false #(|| #name::#variants as #integer == 0)*, #zero);
    };
    let type_name = name.to_string();

    Ok(quote! {
        #proof

        // SAFETY: laid out as the integer of its `repr`; `validate` accepts the values of its variants, and the assert
        // above proves that 0 is among them.
        #[automatically_derived]
        unsafe impl #krate::Plain for #name {
            const CDR_SIZE: usize = ::core::mem::size_of::<#integer>();
            const FIRST_ALIGN: usize = ::core::mem::size_of::<#integer>();
            const CONTENT_SIZE: usize = ::core::mem::size_of::<#integer>();
            const SHAPE: #krate::Shape = <#integer as #krate::Plain>::SHAPE;
            const ALWAYS_VALID: bool = false;

            #[inline]
            fn clear_padding(_: &mut [u8]) {}

            #[inline]
            fn validate(bytes: &[u8]) -> ::core::result::Result<(), #krate::Invalid> {
                let value = #integer::from_le_bytes(
                    #krate::layout::read::<{ ::core::mem::size_of::<#integer>() }, Self>(bytes)?,
                );
                if false #(|| value == #name::#variants as #integer)* {
                    return ::core::result::Result::Ok(());
                }
                ::core::result::Result::Err(#krate::Invalid::Value {
                    offset: 0,
                    value: ::core::primitive::i64::from(value),
                    type_name: #type_name,
                })
            }

            #[inline]
            fn write_fields(&self, out: &mut [u8]) {
                #krate::Plain::write_fields(&(*self as #integer), out);
            }
        }

        #[automatically_derived]
        impl #krate::cdr::Form for #name {
            type Value = Self;
            const MIN_SIZE: usize = ::core::mem::size_of::<#integer>();

            #[inline]
            fn end(_: &Self, at: usize) -> usize {
                <#integer as #krate::cdr::Form>::end(&0, at)
            }

            #[inline]
            fn write(value: &Self, writer: &mut #krate::cdr::Writer<'_>) -> #krate::cdr::Encoded<()> {
                <#integer as #krate::cdr::Form>::write(&(*value as #integer), writer)
            }

            #[inline]
            fn read(reader: &mut #krate::cdr::Reader<'_>) -> #krate::cdr::Decoded<Self> {
                let value = <#integer as #krate::cdr::Form>::read(reader)?;
                #(
                    if value == #name::#variants as #integer {
                        return ::core::result::Result::Ok(#name::#variants);
                    }
                )*
                let value = ::core::primitive::i64::from(value);
                ::core::result::Result::Err(reader.no_value(
                    value,
                    &#type_name,
                    ::core::mem::size_of::<#integer>(),
                ))
            }
        }
    })
}
