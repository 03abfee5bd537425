//! One Python class for every number of axes: enums over the const-generic Rust types.

use pyo3::{exceptions::PyValueError, prelude::*};

pub(crate) fn refuse_axes(axes: usize) -> PyErr {
    PyValueError::new_err(format!("axes = {axes}: must be 1 to 7"))
}

/// Convert an error of the crates to `ValueError`; its text states the value and the limits.
pub(crate) fn refuse(error: impl std::fmt::Display) -> PyErr {
    PyValueError::new_err(error.to_string())
}

/// Evaluates an expression for a number of axes; `$n` is that number as a constant.
macro_rules! of_axes {
    ($axes:expr, $n:ident => $body:expr) => {
        haptether_numeric::of_axes!($axes, $n => $body, axes => return Err(crate::axes::refuse_axes(axes)))
    };
}
pub(crate) use of_axes;

/// Declares an enum with one variant per number of axes.
macro_rules! per_axes {
    ($(#[$doc:meta])* $name:ident, $inner:ident) => {
        $(#[$doc])*
        // The variants live inside a Python object, which is on the heap already.
        #[allow(clippy::large_enum_variant)]
        #[derive(Clone)]
        pub(crate) enum $name {
            One($inner<1>),
            Two($inner<2>),
            Three($inner<3>),
            Four($inner<4>),
            Five($inner<5>),
            Six($inner<6>),
            Seven($inner<7>),
        }
    };
}

/// Evaluates an expression on the inner value; `N` is its number of axes.
macro_rules! with_axes {
    ($of:expr, $name:ident, $inner:ident => $body:expr) => {
        match $of {
            $name::One($inner) => {
                #[allow(dead_code)]
                const N: usize = 1;
                $body
            }
            $name::Two($inner) => {
                #[allow(dead_code)]
                const N: usize = 2;
                $body
            }
            $name::Three($inner) => {
                #[allow(dead_code)]
                const N: usize = 3;
                $body
            }
            $name::Four($inner) => {
                #[allow(dead_code)]
                const N: usize = 4;
                $body
            }
            $name::Five($inner) => {
                #[allow(dead_code)]
                const N: usize = 5;
                $body
            }
            $name::Six($inner) => {
                #[allow(dead_code)]
                const N: usize = 6;
                $body
            }
            $name::Seven($inner) => {
                #[allow(dead_code)]
                const N: usize = 7;
                $body
            }
        }
    };
}

/// Builds the variant for a number of axes known at run time; `N` is that number as a constant.
macro_rules! build_axes {
    ($axes:expr, $name:ident, $body:expr) => {
        match $axes {
            1 => {
                const N: usize = 1;
                $name::One($body)
            }
            2 => {
                const N: usize = 2;
                $name::Two($body)
            }
            3 => {
                const N: usize = 3;
                $name::Three($body)
            }
            4 => {
                const N: usize = 4;
                $name::Four($body)
            }
            5 => {
                const N: usize = 5;
                $name::Five($body)
            }
            6 => {
                const N: usize = 6;
                $name::Six($body)
            }
            7 => {
                const N: usize = 7;
                $name::Seven($body)
            }
            other => return Err($crate::axes::refuse_axes(other)),
        }
    };
}

/// Builds the variant with the axes of a device model.
macro_rules! build_like {
    ($device:expr, $name:ident, $model:ident => $body:expr) => {
        match $device {
            AnyDevice::One($model) => $name::One($body),
            AnyDevice::Two($model) => $name::Two($body),
            AnyDevice::Three($model) => $name::Three($body),
            AnyDevice::Four($model) => $name::Four($body),
            AnyDevice::Five($model) => $name::Five($body),
            AnyDevice::Six($model) => $name::Six($body),
            AnyDevice::Seven($model) => $name::Seven($body),
        }
    };
}

pub(crate) use {build_axes, build_like, per_axes, with_axes};
