// SPDX-License-Identifier: MIT OR Apache-2.0
//! What programs for r2r use by names that nothing else here has.

use crate::error::Result;
use std::fmt::Debug;
use tautline_msgs::Message;
use tautline_msgs::serde::{Serialize, de::DeserializeOwned};

/// A message as r2r's programs know it. Every generated type is one.
///
/// ```
/// use tautline::{WrappedTypesupport, std_msgs::msg::String as Text};
///
/// let bytes = Text { data: "taut".into() }.to_serialized_bytes()?;
/// assert_eq!(Text::from_serialized_bytes(&bytes)?.data, "taut");
/// # Ok::<(), tautline::Error>(())
/// ```
pub trait WrappedTypesupport: Message + Serialize + DeserializeOwned + Default + Debug + Clone {
    /// [`Message::to_cdr`] by r2r's name.
    ///
    /// # Errors
    /// [`Error::Serialize`](crate::Error::Serialize) if a string or sequence is longer than its bound.
    fn to_serialized_bytes(&self) -> Result<Vec<u8>> {
        Ok(self.to_cdr()?)
    }

    /// [`Message::from_cdr`] by r2r's name.
    ///
    /// # Errors
    /// [`Error::Deserialize`](crate::Error::Deserialize) with field and byte if these are no message of the type.
    fn from_serialized_bytes(data: &[u8]) -> Result<Self> {
        Ok(Self::from_cdr(data)?)
    }
}

impl<T: Message + Serialize + DeserializeOwned + Default + Debug + Clone> WrappedTypesupport for T {}

/// The ROS 2 whose message definitions are bundled.
pub const ROS_DISTRO: &str = "jazzy";

/// A compile-time error unless there is simulated time.
#[cfg(feature = "rosgraph_msgs")]
#[macro_export]
macro_rules! assert_compiled_with_use_sim_time_support {
    () => {};
}

/// A compile-time error unless there is simulated time.
#[cfg(not(feature = "rosgraph_msgs"))]
#[macro_export]
macro_rules! assert_compiled_with_use_sim_time_support {
    () => {
        ::core::compile_error!("there is no simulated time: give tautline the feature rosgraph_msgs");
    };
}
