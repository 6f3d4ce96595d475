// SPDX-License-Identifier: MIT OR Apache-2.0

/// Implements [`Message`](crate::Message), [`Form`](crate::cdr::Form) and [`Cdr`](crate::cdr::Cdr) for a struct whose
/// fields are listed with their forms. Generated code calls it.
///
/// ```
/// # struct Named { name: String, values: Vec<f64> }
/// use tautline_msgs::cdr::{Bounded, Cdr};
///
/// tautline_msgs::cdr_struct! {
///     "demo_msgs/msg/Named", "RIHS01_00";
///     Named {
///         name: String,
///         values: Bounded<Vec<f64>, 3>,
///     }
/// }
///
/// let named = Named { name: "a".to_owned(), values: vec![1.5] };
/// assert_eq!(named.cdr_len(), 4 + 2 + 2 + 4 + 4 + 8);
/// assert_eq!(Named::from_cdr(&named.to_cdr().unwrap()).unwrap().values, [1.5]);
/// ```
#[macro_export]
macro_rules! cdr_struct {
    // One byte stands for no fields, which writers leave unset.
    ($name:literal, $hash:literal; $type:ident {}) => {
        $crate::cdr_struct!(@traits $type, $name, $hash);

        impl $crate::cdr::Form for $type {
            type Value = Self;
            const MIN_SIZE: usize = 1;

            #[inline]

            fn end(_: &Self, at: usize) -> usize {
                at + 1
            }

            #[inline]

            fn write(
                _: &Self,
                writer: &mut $crate::cdr::Writer<'_>,
            ) -> ::core::result::Result<(), $crate::cdr::EncodeError> {
                writer.put(1, &[0])
            }

            #[inline]

            fn read(
                reader: &mut $crate::cdr::Reader<'_>,
            ) -> ::core::result::Result<Self, $crate::cdr::DecodeError> {
                reader.take(1, 1)?;
                ::core::result::Result::Ok(Self {})
            }
        }
    };
    ($name:literal, $hash:literal; $type:ident { $($field:ident: $form:ty),+ $(,)? }) => {
        $crate::cdr_struct!(@traits $type, $name, $hash);

        impl $crate::cdr::Form for $type {
            type Value = Self;
            const MIN_SIZE: usize = 0usize $(.saturating_add(<$form as $crate::cdr::Form>::MIN_SIZE))+;

            #[inline]

            fn end(value: &Self, at: usize) -> usize {
                $(let at = <$form as $crate::cdr::Form>::end(&value.$field, at);)+
                at
            }

            #[inline]

            fn write(
                value: &Self,
                writer: &mut $crate::cdr::Writer<'_>,
            ) -> ::core::result::Result<(), $crate::cdr::EncodeError> {
                $(
                    if let ::core::result::Result::Err(error) =
                        <$form as $crate::cdr::Form>::write(&value.$field, writer)
                    {
                        return ::core::result::Result::Err(error.within($name, stringify!($field)));
                    }
                )+
                ::core::result::Result::Ok(())
            }

            #[inline]

            fn read(
                reader: &mut $crate::cdr::Reader<'_>,
            ) -> ::core::result::Result<Self, $crate::cdr::DecodeError> {
                ::core::result::Result::Ok(Self {
                    $($field: match <$form as $crate::cdr::Form>::read(reader) {
                        ::core::result::Result::Ok(value) => value,
                        ::core::result::Result::Err(error) => {
                            return ::core::result::Result::Err(error.within($name, stringify!($field)));
                        }
                    },)+
                })
            }
        }
    };
    (@traits $type:ident, $name:literal, $hash:literal) => {
        impl $crate::Message for $type {
            const TYPE_NAME: &'static str = $name;
        }

        impl $crate::cdr::Cdr for $type {
            const TYPE_HASH: &'static str = $hash;
        }
    };
}
