// SPDX-License-Identifier: MIT OR Apache-2.0

/// Implements [`Plain`](crate::Plain) and [`Form`](crate::cdr::Form) for a `#[repr(C)]` struct whose fields are listed
/// with their types. Does not compile if C places one of them where CDR does not.
#[doc(hidden)]
#[macro_export]
macro_rules! plain_struct {
    ($name:literal; $type:ident { $($field:ident: $ty:ty),+ $(,)? }) => {
        $crate::plain_struct! {
            @sized $name; $type { $($field: $ty),+ } (::core::option::Option::Some($name)) where [] {
                let end = 0usize;
                $(
                    let start = end.next_multiple_of(<$ty as $crate::Plain>::FIRST_ALIGN);
                    assert!(
                        ::core::mem::offset_of!($type, $field) == start,
                        concat!("field `", stringify!($field), "` is elsewhere in C than in CDR")
                    );
                    let end = start + <$ty as $crate::Plain>::CDR_SIZE;
                )+
                end
            }
        }
    };
    // Also for the derive, which proves the layout with errors of its own, and names the fields that have to be `Plain`.
    (
        @sized $name:literal; $type:ident { $($field:ident: $ty:ty),+ } ($type_name:expr)
        where [$($bounds:tt)*] $size:block
    ) => {
        $crate::cdr_form! { $name; $type { $($field: $ty),+ } plain where $($bounds)* }

        // SAFETY: `repr(C)`, all fields are `Plain`, zeros are a valid value of each, and the caller, or else evaluating
        // `CDR_SIZE`, proves that C places each field where CDR does.
        unsafe impl $crate::Plain for $type
        where
            $($bounds)*
        {
            const CDR_SIZE: usize = $size;
            const FIRST_ALIGN: usize = {
                let aligns = [$(<$ty as $crate::Plain>::FIRST_ALIGN),+];
                aligns[0]
            };
            const CONTENT_SIZE: usize = 0 $(+ <$ty as $crate::Plain>::CONTENT_SIZE)+;
            const SHAPE: $crate::Shape = $crate::Shape::Struct(&$crate::StructShape {
                ident: ::core::stringify!($type),
                type_name: $type_name,
                fields: &[$((::core::stringify!($field), &<$ty as $crate::Plain>::SHAPE)),+],
            });
            const ALWAYS_VALID: bool = true $(&& <$ty as $crate::Plain>::ALWAYS_VALID)+;

            #[inline]
            fn validate(bytes: &[u8]) -> ::core::result::Result<(), $crate::Invalid> {
                $($crate::layout::validate_at::<$ty>(bytes, ::core::mem::offset_of!($type, $field))?;)+
                ::core::result::Result::Ok(())
            }

            #[inline]
            fn write_fields(&self, out: &mut [u8]) {
                $($crate::Plain::write_fields(&self.$field, &mut out[::core::mem::offset_of!($type, $field)..]);)+
            }

            #[inline]
            fn clear_padding(memory: &mut [u8]) {
                let end = 0usize;
                $(
                    let start = ::core::mem::offset_of!($type, $field);
                    $crate::layout::clear(memory, end, start);
                    $crate::layout::clear_at::<$ty>(memory, start);
                    let end = start + <$ty as $crate::Plain>::CDR_SIZE;
                )+
                let _ = end;
            }
        }

        const _: usize = <$type as $crate::Plain>::CDR_SIZE;
    };
}
