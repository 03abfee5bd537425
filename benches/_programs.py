"""Programs that benches and tests run."""

import os
import select
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

START_S = 60.0
HAPTETHER = (sys.executable, "-m", "haptether")
ROOT = Path(__file__).resolve().parents[1]


def built(name: str, profile: str = "release") -> Path:
    """Build an example of any crate and return its path.

    Like every call of cargo, this one names the whole workspace: features then equal those of the extension, and cargo
    reuses the build of `make setup`.
    """
    command = ["cargo", "build", "--quiet", "--locked", "--workspace", "--profile", profile, "--example", name]
    subprocess.run(command, check=True, cwd=ROOT)
    return Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"), profile, "examples", name)


@contextmanager
def running(*command: str) -> Iterator[str]:
    """Run a program with pipes for input and output; return its first line, and end it in any case.

    Raises:
        RuntimeError: It prints nothing within `START_S`.
    """
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            if not select.select([process.stdout], [], [], START_S)[0]:
                message = f"{command[0]} has said nothing for {START_S:g} s"
                raise RuntimeError(message)
            yield process.stdout.readline().strip()
        finally:
            process.kill()
