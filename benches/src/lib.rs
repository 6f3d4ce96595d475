//! Measurements, one question each
