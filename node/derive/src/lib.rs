// SPDX-License-Identifier: MIT OR Apache-2.0
//! The derive macro behind `tautline::RosParams`; its documentation is at the trait.
#![forbid(unsafe_code)]

use proc_macro_crate::FoundCrate;
use proc_macro2::TokenStream;
use quote::{format_ident, quote, quote_spanned};
use syn::spanned::Spanned;
use syn::{
    Data, DeriveInput, Error, Expr, ExprLit, ExprRange, Field, Fields, Lit, LitStr, RangeLimits, Result,
};

/// Derives `RosParams` for a struct whose fields are parameters or such structs. See `tautline::RosParams`.
#[proc_macro_derive(RosParams, attributes(param))]
pub fn derive_ros_params(input: proc_macro::TokenStream) -> proc_macro::TokenStream {
    let input = syn::parse_macro_input!(input as DeriveInput);
    expand(&input).unwrap_or_else(Error::into_compile_error).into()
}

fn expand(input: &DeriveInput) -> Result<TokenStream> {
    let fields = match &input.data {
        Data::Struct(data) => match &data.fields {
            Fields::Named(fields) => &fields.named,
            other => return Err(Error::new(other.span(), "parameters have names: name the fields")),
        },
        _ => return Err(Error::new_spanned(&input.ident, "parameters are the fields of a struct")),
    };
    let name = &input.ident;
    let (generics, types, bounds) = input.generics.split_for_impl();
    let register = fields.iter().map(register).collect::<Result<Vec<_>>>()?;
    let get = arms(fields.iter(), &quote!(get_parameter(rest)));
    let set = arms(fields.iter(), &quote!(set_parameter(rest, param_val)));
    let check = arms(fields.iter(), &quote!(check_parameter(rest, param_val)));
    // The crate may have another name in the crate of the struct.
    let name_of_crate = |name: &str| match proc_macro_crate::crate_name(name).ok()? {
        FoundCrate::Name(name) => Some(name),
        FoundCrate::Itself => Some(name.replace('-', "_")),
    };
    let name_of_crate = ["tautline", "tautline-r2r"].into_iter().find_map(name_of_crate);
    let name_of_crate = format_ident!("{}", name_of_crate.as_deref().unwrap_or("tautline"));
    Ok(quote! {
        const _: () = {
        extern crate #name_of_crate as tautline;

        impl #generics tautline::RosParams for #name #types #bounds {
            fn register_parameters(
                &mut self,
                prefix: &str,
                _param: ::std::option::Option<tautline::Parameter>,
                params: &mut tautline::indexmap::IndexMap<::std::string::String, tautline::Parameter>,
            ) -> tautline::Result<()> {
                let prefix = if prefix.is_empty() { ::std::string::String::new() } else { ::std::format!("{prefix}.") };
                #(#register)*
                ::std::result::Result::Ok(())
            }

            fn get_parameter(&mut self, param_name: &str) -> tautline::Result<tautline::ParameterValue> {
                let (first, rest) = param_name.split_once('.').unwrap_or((param_name, ""));
                match first {
                    #(#get)*
                    _ => tautline::__private::field(tautline::__private::no_field(), param_name),
                }
            }

            fn set_parameter(
                &mut self,
                param_name: &str,
                param_val: &tautline::ParameterValue,
            ) -> tautline::Result<()> {
                let (first, rest) = param_name.split_once('.').unwrap_or((param_name, ""));
                match first {
                    #(#set)*
                    _ => tautline::__private::field(tautline::__private::no_field(), param_name),
                }
            }

            fn check_parameter(
                &self,
                param_name: &str,
                param_val: &tautline::ParameterValue,
            ) -> tautline::Result<()> {
                let (first, rest) = param_name.split_once('.').unwrap_or((param_name, ""));
                match first {
                    #(#check)*
                    _ => tautline::__private::field(tautline::__private::no_field(), param_name),
                }
            }
        }
        };
    })
}

fn arms<'f>(fields: impl Iterator<Item = &'f Field>, call: &TokenStream) -> Vec<TokenStream> {
    let arm = |field: &Field| {
        let ident = field.ident.as_ref();
        let name = field_name(field);
        let trait_call = quote_spanned!(field.ty.span() => self.#ident.#call);
        quote!(#name => { use tautline::RosParams as _; tautline::__private::field(#trait_call, #name) })
    };
    fields.map(arm).collect()
}

/// The field's name without the `r#` of a keyword.
fn field_name(field: &Field) -> String {
    let name = field.ident.as_ref().map(ToString::to_string).unwrap_or_default();
    name.strip_prefix("r#").unwrap_or(&name).to_owned()
}

fn register(field: &Field) -> Result<TokenStream> {
    let ident = field.ident.as_ref();
    let name = field_name(field);
    let descriptor = descriptor(field)?;
    Ok(quote_spanned! {field.ty.span() =>
        tautline::RosParams::register_parameters(
            &mut self.#ident,
            &::std::format!("{prefix}{}", #name),
            ::std::option::Option::Some(tautline::Parameter::with_descriptor(#descriptor)),
            params,
        )?;
    })
}

/// The descriptor of the field, from `#[param(...)]` and the documentation.
fn descriptor(field: &Field) -> Result<TokenStream> {
    let mut calls = TokenStream::new();
    let (mut description, mut step, mut has_range) = (documentation(field), None, false);
    for attribute in field.attrs.iter().filter(|attribute| attribute.path().is_ident("param")) {
        attribute.parse_nested_meta(|meta| {
            if meta.path.is_ident("description") {
                description = meta.value()?.parse::<LitStr>()?.value();
            } else if meta.path.is_ident("additional_constraints") {
                let text = meta.value()?.parse::<LitStr>()?;
                calls.extend(quote!(.additional_constraints(#text)));
            } else if meta.path.is_ident("read_only") || meta.path.is_ident("dynamic_typing") {
                let call = format_ident!("{}", meta.path.require_ident()?);
                calls.extend(quote!(.#call()));
            } else if meta.path.is_ident("range") {
                has_range = true;
                let range = meta.value()?.parse::<ExprRange>()?;
                let (RangeLimits::Closed(_), Some(from), Some(to)) = (range.limits, &range.start, &range.end) else {
                    return Err(meta.error("expected a range with both ends: `range = 0.0..=1.0`"));
                };
                calls.extend(quote!(.range(#from..=#to)));
            } else if meta.path.is_ident("step") {
                let value = meta.value()?.parse::<Expr>()?;
                step = Some(quote_spanned!(value.span() => .step(#value)));
            } else {
                return Err(meta.error(
                    "expected `description`, `additional_constraints`, `range`, `step`, `read_only` or `dynamic_typing`",
                ));
            }
            Ok(())
        })?;
    }
    if let (Some(step), false) = (&step, has_range) {
        return Err(Error::new(step.span(), "a step needs a range"));
    }
    Ok(quote!(tautline::ParameterDescriptor::new().description(#description)#calls #step))
}

/// The lines of the field's documentation, as one.
fn documentation(field: &Field) -> String {
    let docs = field.attrs.iter().filter(|attribute| attribute.path().is_ident("doc"));
    let lines = docs.filter_map(|attribute| match &attribute.meta.require_name_value().ok()?.value {
        Expr::Lit(ExprLit { lit: Lit::Str(line), .. }) => Some(line.value().trim().to_owned()),
        _ => None,
    });
    lines.collect::<Vec<_>>().join(" ").trim().to_owned()
}
