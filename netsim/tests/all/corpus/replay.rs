//! Replay of the committed corpus of a fuzz target.

use std::{fs, path::Path};

/// Call `target` with each file of `fuzz/corpus/<name>`, in name order.
pub(crate) fn replay(name: &str, target: fn(&[u8])) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus").join(name);
    let entries = fs::read_dir(&folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    let mut files: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
    files.sort();
    assert!(files.len() >= 10, "{}: {} files are no corpus", folder.display(), files.len());
    for file in files {
        // Names the file if `target` panics.
        let _shown = Shown(&file);
        target(&fs::read(&file).unwrap());
    }
}

struct Shown<'a>(&'a Path);

impl Drop for Shown<'_> {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("while replaying {}", self.0.display());
        }
    }
}
