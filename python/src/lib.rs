//! The extension module `haptether._core`.
use pyo3::prelude::*;

/// Entry point of the module.
#[pymodule(gil_used = true)]
fn _core(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))
}
