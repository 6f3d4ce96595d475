//! Zero-copy, real-time middleware for robots: nodes, topics, timers
