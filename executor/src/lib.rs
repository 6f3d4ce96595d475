//! Callback threads: one LocalPool and one priority each
