"""`haptether info`, `plot` and `export`: their output, their files and their refusals."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from tests.recording.files import BEGUN_NS, write_recording

from haptether.bridge import Run, load
from haptether.cli import main

ENGAGED = {"state": "engaged", "reason": "both sides aligned"}


@pytest.fixture
def master(tmp_path: Path) -> Path:
    ticks: list[dict[str, Any]] = [
        {"position": [n * 1e-3], "true_position": [n * 1e-3], "device_force": [-0.1 * n]} for n in range(40)
    ]
    ticks[3] |= ENGAGED
    ticks[20] |= {"tripped": 4}
    ticks[30] |= {"tripped": 0}
    return write_recording(tmp_path / "master.mcap", "master", ticks)


@pytest.fixture
def slave(tmp_path: Path) -> Path:
    ticks: list[dict[str, Any]] = [{"position": [n * 1e-3], "environment_force": [0.1 * n]} for n in range(30)]
    return write_recording(tmp_path / "slave.mcap", "slave", [*ticks, ENGAGED], begun_ns=BEGUN_NS + 5_000_000)


def test_info_says_what_is_in_a_file(master: Path, slave: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(master), str(slave)]) == 0
    printed = capfd.readouterr().out
    assert max(map(len, printed.splitlines())) <= 80
    for text in ("engaged 92.5%", "disengaged 7.5%", "0.039", "trip  wsc", "3.9", "2026-09-21", "encrypted", "whole"):
        assert text in printed, text
    assert main(["info", str(master), "--json", "-"]) == 0
    (report,) = json.loads(capfd.readouterr().out)
    assert (report["side"], report["ticks"], report["axes"], report["whole"]) == ("master", 40, 1, True)
    assert report["states"] == {"engaged": 0.925, "disengaged": 0.075}
    assert report["metrics"]["intervention_s"] == pytest.approx(0.010)
    assert report["settings"] == {"schema": 1, "run": {"seed": 7}}
    assert [event["kind"] for event in report["events"]] == ["engaged", "trip", "recover"]


def test_info_of_a_file_without_a_tick_or_an_end(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    empty = write_recording(tmp_path / "empty.mcap", "slave", [])
    assert main(["info", str(empty)]) == 0
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(write_recording(tmp_path / "m.mcap", "master", [{}] * 500).read_bytes()[:-200])
    assert main(["info", str(cut)]) == 0
    assert "cut off: killed, or the disk was full" in capfd.readouterr().out


@pytest.mark.parametrize(("suffix", "begin"), [(".png", b"\x89PNG"), (".pdf", b"%PDF"), (".svg", b"<?xml")])
def test_plot_draws_both_sides(master: Path, slave: Path, tmp_path: Path, suffix: str, begin: bytes) -> None:
    picture = tmp_path / f"both{suffix}"
    assert main(["plot", str(master), str(slave), "--out", str(picture)]) == 0
    assert picture.read_bytes().startswith(begin)
    assert picture.stat().st_mode & 0o777 == 0o600


def test_plot_of_one_side_lies_beside_its_file(master: Path, slave: Path) -> None:
    for file in (master, slave):
        assert main(["plot", str(file)]) == 0
        assert file.with_suffix(".png").read_bytes().startswith(b"\x89PNG")


def test_export_writes_what_was_recorded(master: Path, slave: Path, tmp_path: Path) -> None:
    targets = {suffix: tmp_path / f"run.{suffix}" for suffix in ("parquet", "csv", "npz")}
    options = [text for suffix, path in targets.items() for text in (f"--{suffix}", str(path))]
    assert main(["export", str(master), str(slave), *options]) == 0
    run = load(master, slave)
    for table in (pl.read_parquet(targets["parquet"]), pl.read_csv(targets["csv"])):
        assert table.columns == list(run.columns())
        np.testing.assert_array_equal(table["device_force"].to_numpy(), run.signals.device_force)
    with np.load(targets["npz"]) as arrays:
        assert set(arrays) == set(run.signals)
    assert main(["export", str(master), str(slave), "--side", "slave", "--csv", str(targets["csv"]), "--force"]) == 0
    table = pl.read_csv(targets["csv"])
    np.testing.assert_array_equal(table["slave_time_s"].to_numpy(), run.signals.slave_time_s)


def test_a_table_alone_goes_to_standard_output(
    master: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    # The exporter writes rows in blocks.
    monkeypatch.setattr("haptether.cli.recording.export.ROWS_AT_ONCE", 7)
    assert main(["export", str(master), "--csv", "run.csv"]) == 0
    assert capfd.readouterr().out == "written: run.csv\n"
    assert main(["export", str(master), "--csv", "-", "--npz", "run.npz"]) == 0
    printed = capfd.readouterr()
    assert printed.out == Path("run.csv").read_text()
    assert len(printed.out.splitlines()) == 41
    assert printed.err == "written: run.npz\n"
    assert not Path("-").exists()


def test_what_cannot_be_done_is_refused(
    master: Path, slave: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "other.mcap").write_bytes(b"not a recording")
    (tmp_path / "link.csv").symlink_to(tmp_path / "nowhere")
    (tmp_path / "full").symlink_to("/dev/full")
    empty = write_recording(tmp_path / "empty.mcap", "master", [])
    for arguments, status, text in (
        (["info"], 2, "which file?"),
        *(
            ([name, str(tmp_path / "none.mcap"), *more], 2, "none.mcap: no such file: give what --")
            for name, more in (
                ("info", ()),
                ("plot", ()),
                ("export", ("--csv", str(tmp_path / "t.csv"))),
                ("replay", ()),
                ("playback", ()),
                ("explain", ()),
            )
        ),
        (["plot", str(master), str(tmp_path)], 2, "is a folder: give what --record of"),
        (["info", str(tmp_path / "other.mcap")], 2, "no recording of Haptether: must be what --record of master"),
        (["plot", str(master), "--out", "run.gif"], 2, "run.gif: must end in .png, .pdf, .svg"),
        (["plot", str(empty)], 2, "has no tick"),
        (["plot", str(master), str(master)], 2, "both are of the master"),
        (["plot", str(master), "--slave-begun-s", "1"], 2, "only master was given"),
        (["plot", str(master), str(slave), "--slave-begun-s", "nan"], 2, "slave_begun_s = nan: must be finite"),
        (["export", str(master)], 2, "what to write?"),
        (["export", str(master), "--side", "slave", "--csv", str(tmp_path / "s.csv")], 2, "there is 'master'"),
        (["export", str(master), "--csv", str(tmp_path / "link.csv")], 1, "is a symbolic link"),
        (["export", str(master), "--csv", str(master)], 2, "give two files"),
        (["export", str(master), str(master), "--csv", str(tmp_path / "a.csv")], 2, "FILE, OTHER: both name"),
        *(
            (["export", str(master), "--csv", "-", f"--{name}", "-"], 2, f"--{name} -: is binary, must be a file")
            for name in ("parquet", "npz", "foxglove")
        ),
        (
            ["export", str(master), "--side", "slave", "--npz", str(tmp_path / "a.npz")],
            2,
            "--side slave: without --parquet or --csv there is no table of one side",
        ),
        *(
            (["export", str(master), f"--{name}", str(tmp_path / "full")], 1, f"{tmp_path / 'full'}: No space left on")
            for name in ("parquet", "csv", "foxglove")
        ),
        (["export", str(master), "--npz", str(tmp_path / "a.csv")], 2, "must end in .npz"),
        (["export", str(master), "--parquet", str(tmp_path / "a.csv")], 2, "must end in .parquet"),
        (["export", str(master), "--csv", str(tmp_path / "a.mcap")], 2, "must end in .csv"),
        (["export", str(master), "--foxglove", str(tmp_path / "a.parquet")], 2, "must end in .mcap"),
        (["replay", str(master), "--format", "pdf"], 2, "--format pdf: no picture is asked for: give --plot, too"),
    ):
        assert main(arguments) == status, arguments
        said = capfd.readouterr().err
        assert text in said, (arguments, said)
        assert said.count("\n") <= 4, said


@pytest.mark.parametrize(
    ("states", "options", "drawn"),
    [
        ({40: "engaged", 60: "hold", 62: "stop"}, [], (3.5, 6.6)),
        ({40: "engaged"}, [], (3.5, 9.9)),
        ({2: "engaged", 95: "disengaged"}, [], None),
        ({40: "engaged", 50: "stop", 70: "engaged", 75: "fault"}, [], (3.5, 7.9)),
        ({40: "engaged", 60: "stop"}, ["--whole"], None),
        ({40: "fault"}, [], None),
    ],
)
@pytest.mark.parametrize("sides", [("master", "slave"), ("slave", "master"), ("slave",)])
def test_plot_draws_the_engaged_part(
    *,
    states: dict[int, str],
    options: list[str],
    drawn: tuple[float, float] | None,
    sides: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    ticks = [
        {"time_ns": n * 100_000_000, **({"state": states[n], "reason": "peer"} if n in states else {})}
        for n in range(100)
    ]
    files = [write_recording(tmp_path / f"{side}.mcap", side, ticks) for side in sides]
    given: list[Run] = []
    monkeypatch.setattr(Run, "plot", lambda run, *_, **__: given.append(run))
    assert main(["plot", *map(str, files), "--out", str(tmp_path / "run.png"), *options]) == 0
    (run,) = given
    for time in {"time_s", "slave_time_s"} & set(run.signals):
        assert (run.signals[time][0], run.signals[time][-1]) == pytest.approx(drawn or (0.0, 9.9), abs=0.101)
    assert all(len(values) == len(run.signals[run.signals.time_of(name)]) for name, values in run.signals.items())
    said = " ".join(capfd.readouterr().out.split())
    assert ("while the two were engaged; --whole draws all" in said) == (drawn is not None)
