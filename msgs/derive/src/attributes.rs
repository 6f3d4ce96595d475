// SPDX-License-Identifier: MIT OR Apache-2.0
//! `#[message(...)]` and `#[repr(...)]` of the type.

use proc_macro2::Span;
use syn::punctuated::Punctuated;
use syn::spanned::Spanned;
use syn::{DeriveInput, Error, LitStr, Meta, Path, Result, Token, parse_quote};

/// The content of `#[message(...)]`.
pub struct Attributes {
    pub name: Option<LitStr>,
    /// Where `nested` stands.
    pub nested: Option<Span>,
    pub krate: Path,
}

impl Attributes {
    pub fn parse(input: &DeriveInput) -> Result<Self> {
        let mut this = Self { name: None, nested: None, krate: parse_quote!(::tautline::msgs) };
        for attribute in input.attrs.iter().filter(|attribute| attribute.path().is_ident("message")) {
            attribute.parse_nested_meta(|meta| {
                if meta.path.is_ident("name") {
                    let name: LitStr = meta.value()?.parse()?;
                    check_name(&name)?;
                    this.name = Some(name);
                } else if meta.path.is_ident("nested") {
                    this.nested = Some(meta.path.span());
                } else if meta.path.is_ident("crate") {
                    this.krate = meta.value()?.parse::<LitStr>()?.parse()?;
                } else {
                    return Err(
                        meta.error("expected `name = \"pkg/msg/Name\"`, `nested` or `crate = \"path\"`")
                    );
                }
                Ok(())
            })?;
        }
        if let (Some(name), Some(_)) = (&this.name, this.nested) {
            return Err(Error::new_spanned(
                name,
                "a struct with a name can be nested as well: remove `nested`",
            ));
        }
        Ok(this)
    }
}

/// ROS 2's rule for `package/msg/Name` (also `srv`, `action`).
fn check_name(name: &LitStr) -> Result<()> {
    let text = name.value();
    let mut parts = text.split('/');
    let tidy = |part: &str| !part.contains("__") && !part.ends_with('_');
    let package = |part: &str| {
        tidy(part)
            && part.starts_with(|c: char| c.is_ascii_lowercase())
            && part.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
    };
    let type_name = |part: &str| {
        tidy(part)
            && part.starts_with(|c: char| c.is_ascii_uppercase())
            && part.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
    };
    let good = parts.next().is_some_and(package)
        && parts.next().is_some_and(|part| matches!(part, "msg" | "srv" | "action"))
        && parts.next().is_some_and(type_name)
        && parts.next().is_none();
    if good {
        return Ok(());
    }
    Err(Error::new_spanned(
        name,
        "a message name is `package/msg/Name`, as in \"demo_msgs/msg/Tick\", with single underscores and none last",
    ))
}

/// The words in `#[repr(...)]`.
pub struct Repr(Vec<Meta>);

impl Repr {
    pub fn parse(input: &DeriveInput) -> Result<Self> {
        let mut words = Vec::new();
        for attribute in input.attrs.iter().filter(|attribute| attribute.path().is_ident("repr")) {
            words.extend(attribute.parse_args_with(Punctuated::<Meta, Token![,]>::parse_terminated)?);
        }
        let changes_layout = |meta: &&Meta| meta.path().is_ident("packed") || meta.path().is_ident("align");
        if let Some(word) = words.iter().find(changes_layout) {
            return Err(Error::new_spanned(
                word,
                "CDR aligns each number to its own size: remove this word and leave `#[repr(C)]`",
            ));
        }
        Ok(Self(words))
    }

    pub fn has(&self, word: &str) -> bool {
        self.0.iter().any(|meta| meta.path().is_ident(word))
    }
}
