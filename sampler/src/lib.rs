//! One highest-priority thread that waits for events and wakes callback threads
