"""Programs in Rust that benches and tests run."""

import os
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def built(name: str, profile: str = "release") -> Path:
    """Builds an example of any crate and returns its path.

    The whole workspace is named, as in every call of cargo: its features are then those of the extension, and cargo
    reuses what `make setup` has built.
    """
    command = ["cargo", "build", "--quiet", "--locked", "--workspace", "--profile", profile, "--example", name]
    subprocess.run(command, check=True, cwd=ROOT)
    return Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"), profile, "examples", name)
