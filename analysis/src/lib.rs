//! Response-time analysis for fixed-priority systems
