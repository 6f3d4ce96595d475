// SPDX-License-Identifier: MIT OR Apache-2.0
//! Bags in rosbag2's other storage, `sqlite3`: one database for each file, a row for each message.

mod reader;
mod writer;

pub use reader::Database;
pub use writer::SqliteWriter;
