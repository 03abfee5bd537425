"""Sweeps without a valid row: exit status 1, and the output has every measurement."""

import json
from pathlib import Path

import pytest

from haptether.cli.entry import main

SHORT = ["--set", "run.duration_s=0.4"]


@pytest.mark.parametrize("stored", [[], ["--out", "a.csv"], ["--out", "a.parquet"], ["--out", "a.npz"]])
@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["--vary", "run.diverged_speed=1e-6,2e-6", "--set", "run.duration_s=1"], 1, "every row failed: 2 diverged"),
        (["--set", "link.forward.loss=1", "--vary", "run.seed=1,2,3"], 1, "every row failed: 3 never-engaged"),
        (["--vary", "link.forward.loss=1,2"], 1, "every row failed: 1 never-engaged, 1 refused"),
        (["--vary", "safety.window=0,-1"], 2, "row 0: [safety] window = 0: must be 1 to 3600000"),
        (["--vary", "link.forward.loss=1,0"], 0, ""),
    ],
)
def test_a_sweep_of_failed_rows_fails(
    *,
    arguments: list[str],
    status: int,
    said: str,
    stored: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    given = arguments if "run.duration_s=1" in arguments else [*arguments, *SHORT]
    # Run twice: nothing left over may block the second run.
    for replaced in ([], ["--force"]):
        assert main(["sweep", "remote_push", *given, *stored, "--json", "rows.json", *replaced]) == status
        errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("haptether: ")]
        assert errors == ([f"haptether: {said}"] if said else [])
    if status < 2:
        assert len(json.loads((tmp_path / "rows.json").read_text())["rows"]) >= 2
        assert not stored or (tmp_path / stored[1]).stat().st_size
    assert not list(tmp_path.glob("*.partial"))
