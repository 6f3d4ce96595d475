// SPDX-License-Identifier: MIT OR Apache-2.0

/// Implements [`View`](crate::cdr::View) and [`Fill`](crate::cdr::Fill) for a plain struct without padding before, within
/// or after it: a value in a body, and any number of them, are references.
#[doc(hidden)]
#[macro_export]
macro_rules! dense_struct {
    ($type:ident) => {
        impl $crate::cdr::View for $type {
            type Ref<'a> = &'a Self;
            $crate::dense_struct!(@lists);

            #[inline]
            fn view_value<'a>(reader: &mut $crate::cdr::Reader<'a>) -> $crate::cdr::Decoded<&'a Self> {
                $crate::cdr::dense::view_one(reader)
            }

            #[inline]
            fn view_list<'a>(
                reader: &mut $crate::cdr::Reader<'a>,
                len: usize,
            ) -> $crate::cdr::Decoded<&'a [Self]> {
                $crate::cdr::dense::view_list(reader, len)
            }

            #[inline]
            fn view_array<'a, const N: usize>(
                reader: &mut $crate::cdr::Reader<'a>,
            ) -> $crate::cdr::Decoded<&'a [Self; N]> {
                $crate::cdr::dense::view_array(reader, $crate::cdr::dense::view_list)
            }

            #[inline]
            fn own(view: &Self) -> Self {
                *view
            }
        }

        $crate::dense_struct!(@fill $type);
    };
    // Numbers use these, too.
    (@lists) => {
        type List<'a> = &'a [Self];
        type Array<'a, const LEN: usize> = &'a [Self; LEN];

        #[inline]
        fn own_list(view: &[Self]) -> ::std::vec::Vec<Self> {
            view.to_vec()
        }

        #[inline]
        fn own_array<const LEN: usize>(view: &[Self; LEN]) -> [Self; LEN] {
            *view
        }
    };
    (@fill $type:ident) => {
        impl $crate::cdr::Fill for $type {
            type Sizes<'s> = ();
            type ListSizes<'s> = usize;
            type ArraySizes<'s> = ();
            type Writer<'a, 's> = $crate::cdr::Field<'a, Self>;
            type ListWriter<'a, 's> = $crate::cdr::Slice<'a, Self>;
            type ArrayWriter<'a, 's, const N: usize> = $crate::cdr::Slice<'a, Self>;

            $crate::sizes_of_values! {
                fn sizes_from<'s>(_: ::core::option::Option<&Self>, _: &mut impl $crate::cdr::SizeSource<'s>) {}
                fn list_sizes_from<'s>(
                    values: ::core::option::Option<&[Self]>,
                    source: &mut impl $crate::cdr::SizeSource<'s>,
                ) -> usize {
                    source.len(values.map(<[Self]>::len))
                }
                fn array_sizes_from<'s>(_: ::core::option::Option<&[Self]>, _: &mut impl $crate::cdr::SizeSource<'s>) {}
            }

            #[inline]
            fn sized_end(_: (), at: usize) -> usize {
                $crate::cdr::dense::end::<Self>(1, at)
            }

            #[inline]
            fn sized_list_end(len: usize, at: usize) -> usize {
                $crate::cdr::dense::end::<Self>(len, at)
            }

            #[inline]
            fn sized_array_end(_: (), len: usize, at: usize) -> usize {
                $crate::cdr::dense::end::<Self>(len, at)
            }

            #[inline]
            fn carve<'a, 's: 's>(
                _: (),
                carver: &mut $crate::cdr::Carver<'a>,
            ) -> $crate::cdr::Encoded<$crate::cdr::Field<'a, Self>> {
                $crate::cdr::dense::field(carver)
            }

            #[inline]
            fn carve_list<'a, 's: 's>(
                len: usize,
                bound: usize,
                carver: &mut $crate::cdr::Carver<'a>,
            ) -> $crate::cdr::Encoded<$crate::cdr::Slice<'a, Self>> {
                carver.length(len, bound)?;
                $crate::cdr::dense::values(len, carver)
            }

            #[inline]
            fn carve_array<'a, 's: 's, const N: usize>(
                _: (),
                carver: &mut $crate::cdr::Carver<'a>,
            ) -> $crate::cdr::Encoded<$crate::cdr::Slice<'a, Self>> {
                $crate::cdr::dense::values(N, carver)
            }
        }
    };
}
