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
            fn write(_: &Self, writer: &mut $crate::cdr::Writer<'_>) -> $crate::cdr::Encoded<()> {
                writer.put(1, &[0])
            }

            #[inline]
            fn read(reader: &mut $crate::cdr::Reader<'_>) -> $crate::cdr::Decoded<Self> {
                reader.take(1, 1)?;
                ::core::result::Result::Ok(Self {})
            }
        }
    };
    ($name:literal; $type:ident { $($field:ident: $form:ty),+ $(,)? } $($plain:ident where $($bounds:tt)*)?) => {
        impl $crate::cdr::Form for $type $(where $($bounds)*)? {
            type Value = Self;
            const MIN_SIZE: usize = 0usize $(.saturating_add(<$form as $crate::cdr::Form>::MIN_SIZE))+;

            #[inline]
            fn end(value: &Self, at: usize) -> usize {
                $crate::cdr_form!(@end $($plain)?, at);
                $(let at = <$form as $crate::cdr::Form>::end(&value.$field, at);)+
                at
            }

            #[inline]
            fn write(value: &Self, writer: &mut $crate::cdr::Writer<'_>) -> $crate::cdr::Encoded<()> {
                $crate::cdr_form!(@write $($plain)?, $name, ::core::slice::from_ref(value), writer);
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
            fn read(reader: &mut $crate::cdr::Reader<'_>) -> $crate::cdr::Decoded<Self> {
                $crate::cdr_form!(@read $($plain)?, reader);
                ::core::result::Result::Ok(Self {
                    $($field: match <$form as $crate::cdr::Form>::read(reader) {
                        ::core::result::Result::Ok(value) => value,
                        ::core::result::Result::Err(fault) => {
                            return ::core::result::Result::Err(reader.in_field(fault, &stringify!($field)));
                        }
                    },)+
                })
            }

            $crate::cdr_form!(@bulk $($plain)?, $name);
        }
    };
    (@end , $at:ident) => {};
    (@end plain, $at:ident) => {
        if let ::core::option::Option::Some(end) = $crate::dense_end::<Self>($at) {
            return end;
        }
    };
    (@write , $name:literal, $values:expr, $writer:ident) => {};
    (@write plain, $name:literal, $values:expr, $writer:ident) => {
        if let ::core::option::Option::Some(written) = $crate::write_dense($values, $writer) {
            return written.map_err(|error| error.within($name, ""));
        }
    };
    (@read , $reader:ident) => {};
    (@read plain, $reader:ident) => {
        if let ::core::option::Option::Some(value) = $crate::read_dense::<Self>($reader) {
            return ::core::result::Result::Ok(value);
        }
    };
    (@bulk , $name:literal) => {};
    (@bulk plain, $name:literal) => {
        #[inline]
        fn write_all(values: &[Self], writer: &mut $crate::cdr::Writer<'_>) -> $crate::cdr::Encoded<()> {
            $crate::cdr_form!(@write plain, $name, values, writer);
            values.iter().try_for_each(|value| <Self as $crate::cdr::Form>::write(value, writer))
        }

        fn read_vec(
            reader: &mut $crate::cdr::Reader<'_>,
            len: usize,
        ) -> $crate::cdr::Decoded<::std::vec::Vec<Self>> {
            match $crate::read_dense_vec(reader, len) {
                ::core::option::Option::Some(values) => ::core::result::Result::Ok(values),
                ::core::option::Option::None => $crate::cdr::read_one_by_one::<Self>(reader, len),
            }
        }
    };
}
