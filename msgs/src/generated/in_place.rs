// SPDX-License-Identifier: MIT OR Apache-2.0

/// Implements [`View`](crate::cdr::View) with a struct of getters and [`Fill`](crate::cdr::Fill) with a struct of pieces.
///
/// Each field is listed with its form, with what its getter gives, and in brackets its name if it has sizes.
#[doc(hidden)]
#[macro_export]
macro_rules! in_place {
    (@sizes $sizes:ident) => {
        ::core::default::Default::default()
    };
    (@sizes $sizes:ident $field:ident) => {
        $sizes.$field
    };
    (@byte $carver:ident, ) => {{
        $carver.take(1, 1)?.fill(0);
    }};
    (@byte $carver:ident, $($field:ident)+) => {};
    (@skip $reader:ident, ) => {{
        $reader.take(1, 1)?;
    }};
    (@skip $reader:ident, $($field:ident)+) => {};
    (@end $at:expr, ) => {
        $at.saturating_add(1)
    };
    (@end $at:expr, $($field:ident)+) => {
        $at
    };
    (
        $name:literal;
        $type:ident $view:ident $writer:ident $sizes:ty;
        { $($(#[$docs:meta])* $field:ident: $form:ty as $ref:ty [$($sized:ident)?],)* }
    ) => {
        #[doc = concat!("Reads [`", stringify!($type), "`] in place.")]
        #[derive(Clone, Copy)]
        pub struct $view<'a> {
            $($field: $ref,)*
            _body: ::core::marker::PhantomData<&'a [u8]>,
        }

        impl<'a> $view<'a> {
            /// The message as an owned one.
            pub fn to_owned(&self) -> $type {
                <$type as $crate::cdr::View>::own(*self)
            }

            $(
                $(#[$docs])*
                #[inline]
                pub fn $field(&self) -> $ref {
                    self.$field
                }
            )*
        }

        impl ::core::fmt::Debug for $view<'_> {
            fn fmt(&self, formatter: &mut ::core::fmt::Formatter<'_>) -> ::core::fmt::Result {
                formatter
                    .debug_struct(stringify!($view))
                    $(.field(stringify!($field), &self.$field))*
                    .finish()
            }
        }

        #[doc = concat!("Writes [`", stringify!($type), "`] in place: a piece for each field, each to be set.")]
        #[derive(Debug)]
        pub struct $writer<'a, 's> {
            $($(#[$docs])* pub $field: <$form as $crate::cdr::Fill>::Writer<'a, 's>,)*
            _body: ::core::marker::PhantomData<(&'a mut [u8], &'s ())>,
        }

        impl<'a, 's> $writer<'a, 's> {
            /// Sets what was not set yet to the defaults of the definition.
            pub fn default_rest(&mut self) {
                $crate::cdr::Piece::<$type>::default_rest(self, ::core::option::Option::None);
            }
        }

        impl<'a, 's> $crate::cdr::Piece<$type> for $writer<'a, 's> {
            #[inline]
            fn check(&self) -> ::core::result::Result<(), $crate::cdr::WriteError> {
                $(
                    if let ::core::result::Result::Err(error) = <<$form as $crate::cdr::Fill>::Writer<'a, 's>
                        as $crate::cdr::Piece<<$form as $crate::cdr::Form>::Value>>::check(&self.$field)
                    {
                        return ::core::result::Result::Err(error.within($name, stringify!($field)));
                    }
                )*
                ::core::result::Result::Ok(())
            }

            fn default_rest(&mut self, value: ::core::option::Option<&$type>) {
                let default;
                let value = match value {
                    ::core::option::Option::Some(value) => value,
                    ::core::option::Option::None => {
                        default = <$type as ::core::default::Default>::default();
                        &default
                    }
                };
                $(
                    <<$form as $crate::cdr::Fill>::Writer<'a, 's>
                        as $crate::cdr::Piece<<$form as $crate::cdr::Form>::Value>>::default_rest(
                        &mut self.$field,
                        ::core::option::Option::Some(&value.$field),
                    );
                )*
                let _ = value;
            }
        }

        impl $crate::cdr::View for $type {
            type Ref<'a> = $view<'a>;
            $crate::viewed_one_by_one!();

            #[inline]
            fn view_value<'a>(reader: &mut $crate::cdr::Reader<'a>) -> $crate::cdr::Decoded<$view<'a>> {
                $crate::in_place!(@skip reader, $($field)*);
                ::core::result::Result::Ok($view {
                    $($field: match <$form as $crate::cdr::View>::view_value(reader) {
                        ::core::result::Result::Ok(value) => value,
                        ::core::result::Result::Err(fault) => {
                            return ::core::result::Result::Err(reader.in_field(fault, &stringify!($field)));
                        }
                    },)*
                    _body: ::core::marker::PhantomData,
                })
            }

            fn own(view: $view<'_>) -> Self {
                let _ = view;
                Self { $($field: <$form as $crate::cdr::View>::own(view.$field),)* }
            }
        }

        impl $crate::cdr::Fill for $type {
            type Sizes<'s> = $sizes;
            type Writer<'a, 's> = $writer<'a, 's>;
            $crate::one_by_one!();

            $crate::sizes_of_values! {
                fn sizes_from<'s>(
                    value: ::core::option::Option<&Self>,
                    source: &mut impl $crate::cdr::SizeSource<'s>,
                ) -> Self::Sizes<'s> {
                    let _ = (value, &source);
                    #[allow(unused_mut, clippy::needless_update)]
                    let mut sizes = <Self::Sizes<'s> as ::core::default::Default>::default();
                    $($(
                        sizes.$sized = <$form as $crate::cdr::Fill>::sizes_from(
                            value.map(|value| &value.$sized),
                            source,
                        );
                    )?)*
                    sizes
                }
            }

            #[inline]
            fn sized_end(sizes: Self::Sizes<'_>, at: usize) -> usize {
                $(
                    let at = <$form as $crate::cdr::Fill>::sized_end(
                        $crate::in_place!(@sizes sizes $($sized)?),
                        at,
                    );
                )*
                let _ = sizes;
                $crate::in_place!(@end at, $($field)*)
            }

            #[inline]
            fn carve<'a, 's: 's>(
                sizes: $sizes,
                carver: &mut $crate::cdr::Carver<'a>,
            ) -> $crate::cdr::Encoded<$writer<'a, 's>> {
                $crate::in_place!(@byte carver, $($field)*);
                let _ = sizes;
                ::core::result::Result::Ok($writer {
                    $($field: match <$form as $crate::cdr::Fill>::carve(
                        $crate::in_place!(@sizes sizes $($sized)?),
                        carver,
                    ) {
                        ::core::result::Result::Ok(piece) => piece,
                        ::core::result::Result::Err(error) => {
                            return ::core::result::Result::Err(error.within($name, stringify!($field)));
                        }
                    },)*
                    _body: ::core::marker::PhantomData,
                })
            }
        }
    };
}
