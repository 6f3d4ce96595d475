// SPDX-License-Identifier: MIT OR Apache-2.0

/// Implements [`Message`](crate::Message): `plain` for a message that is read through `&Self`, else with the name of its view.
#[doc(hidden)]
#[macro_export]
macro_rules! message {
    (plain $type:ident $name:literal $definition:tt $(where $($bounds:tt)*)?) => {
        impl $crate::Message for $type $(where $($bounds)*)? {
            type View<'a> = &'a Self;
            const FIXED_LEN: ::core::option::Option<usize> =
                ::core::option::Option::Some(<Self as $crate::Plain>::CDR_SIZE);
            // SAFETY: see `view`.
            const PLAIN: ::core::option::Option<$crate::PlainView<Self>> =
                ::core::option::Option::Some(unsafe { $crate::PlainView::new() });
            const SHAPE: ::core::option::Option<&'static $crate::Shape> =
                ::core::option::Option::Some(&<Self as $crate::Plain>::SHAPE);
            $crate::message!(@definition $name $definition);

            #[inline]
            fn view(body: $crate::Body<'_>) -> ::core::result::Result<&Self, $crate::cdr::DecodeError> {
                $crate::view_plain(body)
            }

            #[inline]
            fn shorten<'short, 'long: 'short>(view: &'long Self) -> &'short Self {
                view
            }

            #[inline]
            fn owned(view: &Self) -> Self {
                *view
            }

            #[inline]
            fn clear_gaps(memory: &mut [u8]) {
                $crate::layout::clear_at::<Self>(memory, 0);
            }
        }
    };
    ($view:ident $type:ident $name:literal $definition:tt) => {
        impl $crate::Message for $type {
            type View<'a> = $view<'a>;
            const FIXED_LEN: ::core::option::Option<usize> = ::core::option::Option::None;
            $crate::message!(@definition $name $definition);

            #[inline]
            fn view(body: $crate::Body<'_>) -> ::core::result::Result<$view<'_>, $crate::cdr::DecodeError> {
                $crate::cdr::view_message::<Self>(body)
            }

            #[inline]
            fn shorten<'short, 'long: 'short>(view: $view<'long>) -> $view<'short> {
                view
            }

            fn owned(view: $view<'_>) -> Self {
                <Self as $crate::cdr::View>::own(view)
            }
        }
    };
    (@definition $name:literal {}) => {
        const TYPE_NAME: &'static str = $name;
        const TYPE_HASH: ::core::option::Option<&'static str> = ::core::option::Option::None;
        const DEFINITION: ::core::option::Option<&'static $crate::Definition> = ::core::option::Option::None;
    };
    (@definition $name:literal { $hash:literal, $text:literal, [$($nested:ty),* $(,)?] $(,)? }) => {
        const TYPE_NAME: &'static str = $name;
        const TYPE_HASH: ::core::option::Option<&'static str> = ::core::option::Option::Some($hash);
        const DEFINITION: ::core::option::Option<&'static $crate::Definition> =
            ::core::option::Option::Some(&$crate::Definition {
                type_name: $name,
                text: $text,
                nested: &[$($crate::definition_of::<$nested>()),*],
            });
    };
}

/// Implements [`HasStamp`](crate::HasStamp) for a message with a `std_msgs/Header header`.
#[doc(hidden)]
#[macro_export]
macro_rules! stamped {
    ($type:ident) => {
        impl $crate::HasStamp for $type {
            #[inline]
            fn stamp_ns(view: Self::View<'_>) -> i64 {
                let stamp = view.header().stamp();
                $crate::time_ns(stamp.sec, stamp.nanosec)
            }
        }
    };
}
