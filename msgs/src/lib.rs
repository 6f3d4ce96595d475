//! Messages of fixed layout whose bytes in memory are their CDR
