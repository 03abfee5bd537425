//! Callback for a vendor's scheduler: the only code in this crate that calls foreign functions or reads a
//! clock.

mod hd_callback;
mod latest;

pub use hd_callback::{HdCallback, HdErrorInfo, HdFunctions, HdSample};
