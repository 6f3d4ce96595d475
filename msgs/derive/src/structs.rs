// SPDX-License-Identifier: MIT OR Apache-2.0
//! Structs: `Plain` field by field, the proof of their layout, and `Message` if they have a name.

use proc_macro2::{Delimiter, Group, Span, TokenStream, TokenTree};
use quote::{ToTokens, quote, quote_spanned};
use syn::spanned::Spanned;
use syn::{DataStruct, DeriveInput, Error, Expr, Field, Fields, Ident, LitStr, Path, Result, Type};

use crate::attributes::{Attributes, Repr};

pub fn expand(
    input: &DeriveInput,
    data: &DataStruct,
    attributes: &Attributes,
    repr: &Repr,
) -> Result<TokenStream> {
    let name = &input.ident;
    let krate = &attributes.krate;
    if !repr.has("C") {
        return Err(Error::new_spanned(
            name,
            format!("the layout of struct `{name}` is not stated: add `#[repr(C)]`"),
        ));
    }
    let fields = named_fields(name, data)?;
    for field in &fields {
        check_type(&field.ty)?;
    }

    let idents: Vec<_> = fields.iter().filter_map(|field| field.ident.as_ref()).collect();
    let types: Vec<_> = fields.iter().map(|field| parenthesised(&field.ty)).collect();
    let types: Vec<_> = types.iter().collect();
    let last = types[types.len() - 1];
    let last_ident = idents[idents.len() - 1];
    // One error at the field of a type that is not plain, in place of one for each use below.
    let bounds: Vec<_> = types
        .iter()
        .map(|ty| {
            let krate = respanned(krate, ty.span());
            quote_spanned!(ty.span()=> #ty: #krate::Plain)
        })
        .collect();
    let message = message_impl(name, attributes, &bounds)?;
    let proofs = fields.windows(2).map(|pair| proof(name, krate, pair[0], pair[1]));

    let literal = attributes.name.as_ref().map_or_else(String::new, LitStr::value);
    let type_name = match &attributes.name {
        Some(type_name) => quote!(::core::option::Option::Some(#type_name)),
        None => quote!(::core::option::Option::None),
    };

    Ok(quote! {
        #message

        #(#proofs)*

        #krate::plain_struct! {
            @sized #literal; #name { #(#idents: #types),* } (#type_name) where [#(#bounds,)*] {
                ::core::mem::offset_of!(#name, #last_ident) + <#last as #krate::Plain>::CDR_SIZE
            }
        }
    })
}

/// The same type with parentheses where a macro of the user's passed a part of an array's length, `$kib * 1024` say: the
/// invisible parentheses that are there are lost on the way back to the compiler.
fn parenthesised(ty: &Type) -> Type {
    match ty {
        Type::Array(array) => {
            let mut array = array.clone();
            array.elem = Box::new(parenthesised(&array.elem));
            array.len = Expr::Verbatim(visible(array.len.to_token_stream()));
            Type::Array(array)
        }
        Type::Group(group) => parenthesised(&group.elem),
        other => other.clone(),
    }
}

fn visible(tokens: TokenStream) -> TokenStream {
    let token = |token| match token {
        TokenTree::Group(group) => {
            let delimiter = match group.delimiter() {
                Delimiter::None => Delimiter::Parenthesis,
                other => other,
            };
            let mut visible = Group::new(delimiter, visible(group.stream()));
            visible.set_span(group.span());
            TokenTree::Group(visible)
        }
        other => other,
    };
    tokens.into_iter().map(token).collect()
}

fn message_impl(name: &Ident, attributes: &Attributes, bounds: &[TokenStream]) -> Result<TokenStream> {
    let krate = &attributes.krate;
    match (&attributes.name, attributes.nested) {
        (Some(type_name), _) => Ok(quote! {
            #krate::message! { plain #name #type_name {} where #(#bounds,)* }
        }),
        (None, Some(_)) => Ok(TokenStream::new()),
        (None, None) => Err(Error::new_spanned(
            name,
            format!(
                "message `{name}` has no ROS name: add `#[message(name = \"my_msgs/msg/{name}\")]`, or \
                 `#[message(nested)]` if it is only a field of other messages"
            ),
        )),
    }
}

fn named_fields<'a>(name: &Ident, data: &'a DataStruct) -> Result<Vec<&'a Field>> {
    match &data.fields {
        Fields::Named(fields) if !fields.named.is_empty() => Ok(fields.named.iter().collect()),
        Fields::Unnamed(_) => Err(Error::new_spanned(
            name,
            format!(
                "the fields of message `{name}` need names, as in a .msg file: write `struct {name} {{ .. }}`"
            ),
        )),
        _ => Err(Error::new_spanned(
            name,
            format!(
                "message `{name}` is empty: add `structure_needs_at_least_one_member: u8`, as ROS 2 does"
            ),
        )),
    }
}

/// Refuses types that rustc would refuse with a longer message.
fn check_type(ty: &Type) -> Result<()> {
    let advice = match ty {
        Type::Reference(_) | Type::Ptr(_) | Type::BareFn(_) => {
            "an address means nothing in another process: hold the value"
        }
        Type::Array(array) => return check_type(&array.elem),
        Type::Tuple(_) => "a tuple has no stated layout: use a struct with `#[derive(Message)]`",
        Type::Path(path) if path.path.is_ident("usize") => {
            "`usize` differs between machines: use `u64` or `u32`"
        }
        Type::Path(path) if path.path.is_ident("isize") => {
            "`isize` differs between machines: use `i64` or `i32`"
        }
        Type::Path(path) if path.path.is_ident("u128") || path.path.is_ident("i128") => {
            "CDR has no integers of 128 bits: use `[u64; 2]`"
        }
        Type::Path(path)
            if path
                .path
                .segments
                .last()
                .is_some_and(|last| last.ident == "String" || last.ident == "Vec") =>
        {
            "this type has no fixed size: use an array of the greatest length and a field for the length"
        }
        _ => return Ok(()),
    };
    Err(Error::new_spanned(ty, advice))
}

/// A compile-time check that `field` lies where CDR places it after `previous`.
fn proof(name: &Ident, krate: &Path, previous: &Field, field: &Field) -> TokenStream {
    let struct_name = name.to_string();
    let [previous, described] = [previous, field].map(|field| {
        let (ident, ty) = (&field.ident, &parenthesised(&field.ty));
        let field_name = ident.to_token_stream().to_string();
        let type_name = type_text(ty);
        quote! {
            #krate::layout::Field {
                name: #field_name,
                type_name: #type_name,
                offset: ::core::mem::offset_of!(#name, #ident),
                size: ::core::mem::size_of::<#ty>(),
                cdr_size: <#ty as #krate::Plain>::CDR_SIZE,
                first_align: <#ty as #krate::Plain>::FIRST_ALIGN,
            }
        }
    });
    let krate = respanned(krate, field.span());
    quote_spanned! {field.span()=>
        const _: () = #krate::layout::check(#struct_name, &#previous, &#described);
    }
}

/// `path` with the place `span`, so that rustc points there.
fn respanned(path: &Path, span: Span) -> TokenStream {
    let at_span = |mut token: TokenTree| {
        token.set_span(span);
        token
    };
    path.to_token_stream().into_iter().map(at_span).collect()
}

/// `[u8; 3]` instead of `[u8 ; 3]`.
fn type_text(ty: &Type) -> String {
    ty.to_token_stream().to_string().replace(" ;", ";").replace(" :: ", "::")
}
