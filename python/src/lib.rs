//! Extension module `haptether._core`: thin classes over the crates. `documented` gives them the docstrings of the stub `_core.pyi`.

// PyO3 functions take arguments by value and by name, so these lints conflict with the Python signatures.
#![allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]

#[macro_use]
extern crate haptether_documented;

use pyo3::prelude::*;

mod arrays;
mod axes;
mod bridge;
mod bridge_live;
mod bridge_trace;
mod device_loop;
mod dynamixel;
mod live;
mod local;
mod netsim;
mod recording;
mod replay;
mod research;
mod reserve;
mod safety;
mod scene;
mod signals;
mod touch;
mod ur;
mod ur_environment;

#[documented]
#[pymodule(gil_used = true)]
fn _core(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    safety::register(module)?;
    local::register(module)?;
    ur::register(module)?;
    netsim::register(module)?;
    dynamixel::register(module)?;
    touch::register(module)?;
    scene::register(module)?;
    recording::register(module)?;
    replay::register(module)?;
    ur_environment::register(module)?;
    bridge_trace::register(module)?;
    bridge::register(module)?;
    bridge_live::register(module)?;
    device_loop::register(module)?;
    signals::register(module)
}
