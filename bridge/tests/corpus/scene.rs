//! Fuzz target: a scene as Python hands it over.

use std::sync::atomic::AtomicBool;

use haptether_bridge::scene::{SceneSpec, simulate};
use serde::Deserialize;

/// Panics unless `bytes` are refused with a word where and why, or are a scene that can be built or refused.
pub(crate) fn check(bytes: &[u8]) {
    let read = serde_json::from_slice::<SceneSpec>(bytes);
    match &read {
        Ok(scene) => {
            // By way of a tree of values, as a sweep reads it.
            let tree: serde_json::Value = serde_json::from_slice(bytes).unwrap();
            assert_eq!(SceneSpec::deserialize(&tree).unwrap(), *scene);
            build(scene);
        }
        Err(error) => {
            let said = error.to_string();
            assert!(said.contains("line ") && said.contains("column "), "{said}");
        }
    }
}

/// Told to stop before it begins: a scene is built and not run.
fn build(scene: &SceneSpec) {
    if let Err(error) = simulate(scene, &AtomicBool::new(true)) {
        let said = error.to_string();
        assert!(!said.is_empty() && !said.contains('\n'), "{said}");
    }
}
