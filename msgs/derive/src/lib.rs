//! The derive macro behind tautline-msgs
