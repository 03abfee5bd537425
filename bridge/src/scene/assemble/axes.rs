//! Numbers of a scene as vectors.

use haptether_safety::Axes;

use super::error::{SceneError, contradiction};

/// One value per axis.
pub(crate) fn axes<const N: usize>(name: &str, values: &[f64]) -> Result<Axes<N>, SceneError> {
    if values.len() == N {
        Ok(Axes::from_column_slice(values))
    } else {
        contradiction(format!("{name}: {} values, must have {N}, one per axis", values.len()))
    }
}

/// One value per axis, of which only the direction counts: so short a vector that its square is 0 has one too.
pub(super) fn direction<const N: usize>(name: &str, values: &[f64]) -> Result<Axes<N>, SceneError> {
    let vector = axes::<N>(name, values)?;
    let most = vector.amax();
    Ok(if most > 0.0 { vector / most } else { vector })
}
