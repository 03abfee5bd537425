//! The callback that a vendor's scheduler calls: the only code here that calls foreign functions or reads a clock.

mod hd_callback;
mod latest;

pub use hd_callback::{HdCallback, HdErrorInfo, HdFunctions, HdSample};
