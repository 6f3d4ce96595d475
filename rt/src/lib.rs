//! Real-time set-up of threads and memory, each setting read back
