"""Rust programs that benches and tests run."""

import os
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def built(name: str, profile: str = "release") -> Path:
    """Build an example of any crate and return its path.

    Like every call of cargo, this one names the whole workspace: features then equal those of the extension, and cargo
    reuses the build of `make setup`.
    """
    command = ["cargo", "build", "--quiet", "--locked", "--workspace", "--profile", profile, "--example", name]
    subprocess.run(command, check=True, cwd=ROOT)
    return Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"), profile, "examples", name)
