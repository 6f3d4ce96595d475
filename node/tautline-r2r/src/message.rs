// SPDX-License-Identifier: MIT OR Apache-2.0
//! Names that exist only for programs written for r2r.

use std::fmt::Debug;
use std::ops::{Deref, DerefMut};
use tautline::msgs::serde::{Serialize, de::DeserializeOwned};
use tautline::{Message, Result};

/// A message in r2r's API. Every generated type implements it.
///
/// ```
/// use tautline_r2r::{WrappedTypesupport, std_msgs::msg::String as Text};
///
/// let bytes = Text { data: "taut".into() }.to_serialized_bytes()?;
/// assert_eq!(Text::from_serialized_bytes(&bytes)?.data, "taut");
/// # Ok::<(), tautline_r2r::Error>(())
/// ```
pub trait WrappedTypesupport: Message + Serialize + DeserializeOwned + Default + Debug + Clone {
    /// [`Message::to_cdr`] by r2r's name.
    ///
    /// # Errors
    /// [`Error::Serialize`](tautline::Error::Serialize) if a string or sequence is longer than its bound.
    fn to_serialized_bytes(&self) -> Result<Vec<u8>> {
        Ok(self.to_cdr()?)
    }

    /// [`Message::from_cdr`] by r2r's name.
    ///
    /// # Errors
    /// [`Error::Deserialize`](tautline::Error::Deserialize) with field and byte if these are no message of the type.
    fn from_serialized_bytes(data: &[u8]) -> Result<Self> {
        Ok(Self::from_cdr(data)?)
    }

    /// A copy of the message.
    fn from_native(message: &NativeMsg<Self>) -> Self {
        message.0.clone()
    }
}

impl<T: Message + Serialize + DeserializeOwned + Default + Debug + Clone> WrappedTypesupport for T {}

/// A message in the form in which r2r passes it to C. Here it is the message itself.
///
/// ```
/// use tautline_r2r::{NativeMsg, std_msgs::msg::Int32};
///
/// let mut native = NativeMsg::<Int32>::new();
/// native.data = 7;
/// assert_eq!(Int32::from_native(&native).data, 7);
/// # use tautline_r2r::WrappedTypesupport;
/// ```
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NativeMsg<T>(T);

impl<T: WrappedTypesupport> NativeMsg<T> {
    /// A message with default values.
    pub fn new() -> Self {
        NativeMsg(T::default())
    }
}

impl<T: WrappedTypesupport> From<&T> for NativeMsg<T> {
    fn from(message: &T) -> Self {
        NativeMsg(message.clone())
    }
}

impl<T> Deref for NativeMsg<T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.0
    }
}

impl<T> DerefMut for NativeMsg<T> {
    fn deref_mut(&mut self) -> &mut T {
        &mut self.0
    }
}

impl<T> AsRef<T> for NativeMsg<T> {
    fn as_ref(&self) -> &T {
        &self.0
    }
}

/// The ROS 2 whose message definitions are bundled.
pub const ROS_DISTRO: &str = "jazzy";

/// Does nothing: simulated time is always available.
#[macro_export]
macro_rules! assert_compiled_with_use_sim_time_support {
    () => {};
}
