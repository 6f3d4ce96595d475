// SPDX-License-Identifier: MIT OR Apache-2.0

/// Implements [`Form`](crate::cdr::Form) for a struct whose fields are listed with their forms.
#[doc(hidden)]
#[macro_export]
macro_rules! cdr_form {
    // One byte stands for no fields.
    ($name:literal; $type:ident {}) => {
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
            ) -> ::core::result::Result<Self, $crate::cdr::Fault> {
                reader.take(1, 1)?;
                ::core::result::Result::Ok(Self {})
            }
        }
    };
    ($name:literal; $type:ident { $($field:ident: $form:ty),+ $(,)? }) => {
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
            ) -> ::core::result::Result<Self, $crate::cdr::Fault> {
                ::core::result::Result::Ok(Self {
                    $($field: match <$form as $crate::cdr::Form>::read(reader) {
                        ::core::result::Result::Ok(value) => value,
                        ::core::result::Result::Err(fault) => {
                            return ::core::result::Result::Err(reader.in_field(fault, &stringify!($field)));
                        }
                    },)+
                })
            }
        }
    };
}
