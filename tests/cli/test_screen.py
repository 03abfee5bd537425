"""Printed output of the commands: at 80 columns nothing is cut, and no foreign text acts on the terminal."""

import io
import json
import re
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args, get_type_hints

import msgspec
import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import RenderableType
from rich.table import Table
from tests.recording.files import write_recording

from haptether.bridge import Metrics, Run, Sweep
from haptether.bridge.devices.check.finding import Finding
from haptether.bridge.scene.run import Signals
from haptether.cli import main
from haptether.cli.device.check_device import print_findings, print_verdict
from haptether.cli.entry import COMMANDS
from haptether.cli.live.explain import Explain
from haptether.cli.live.master import print_push
from haptether.cli.live.run import print_security
from haptether.cli.netsim.proxy import _print as print_proxy
from haptether.cli.netsim.record import Record
from haptether.cli.netsim.traffic import figures_table
from haptether.cli.scene.simulate import Simulate
from haptether.cli.scene.sweep import Sweep as SweepCommand
from haptether.cli.shared.link_table import link_table
from haptether.cli.shared.screen import Screen, screen
from haptether.cli.shared.stop import Stopped, wait
from haptether.cli.shared.table import folded, of_numbers
from haptether.netsim import LinkFigures
from haptether.printable import printable
from haptether.studies import LinkSummary, PushResult

WIDTH = 80
HOSTILE = "[/nope] [red]x[/red] :smile: \x1b[31m\x1b]0;title\x07 \x9b2J \u202eabc \u2066 \x00 \ud800 $\\frac$"
FORBIDDEN = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u061c\u200b-\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def shown(*of: RenderableType) -> str:
    """Return the text of a screen of 80 columns."""
    file = io.StringIO()
    screen = Screen(file=file, width=WIDTH, color_system=None)
    for one in of:
        screen.print(one)
    return file.getvalue()


def fits(text: str) -> None:
    """Assert that no line is too long, and nothing is cut."""
    assert text.strip()
    assert "…" not in text
    for line in text.splitlines():
        assert cell_len(line) <= WIDTH, line


# -------------------------------------------------------------------------------------------------- 80 columns

FAULT = "a device driver said: 'EtherCAT slave 3 lost its process data for 12.345 ms', mend it and start it anew"


def push(controller: str, *, fault: str | None = None) -> PushResult:
    return PushResult(
        controller=controller, security="insecure", engaged_s=123.456, release_s=126.789, peak_hand_speed=12.345,
        peak_force_n=12345.678, time_to_trip_s=12.345, trips_before_release=123456, intervention_s=12345.678,
        sent=123_456_789, lost=123_456_789, late=123_456_789, refused=123_456_789, round_trip_s=12.3456,
        overshoot_p50_s=0.123456, overshoot_p99_s=12.345678, ticks=123_456_789, skipped_ticks=1, holds=123_456,
        outliers=123_456_789, dropped_records=0, unsent=0, force_at_release_n=-12345.678, final_state="disengaged",
        fault=fault,
    )  # fmt: skip


@pytest.mark.parametrize("controllers", [["wsc"], ["none", "hsc", "wsc"], ["none", "vfc", "hsc", "wsc"]])
@pytest.mark.parametrize("fault", [None, FAULT])
def test_the_table_of_a_push_fits(controllers: list[str], fault: str | None) -> None:
    file = io.StringIO()
    print_push(Screen(file=file, width=WIDTH), [push(name, fault=fault) for name in controllers])
    text = file.getvalue()
    fits("\n".join(line for line in text.splitlines() if not line.startswith("fault, ")))
    assert text.count(FAULT) == (0 if fault is None else len(controllers))
    for number in ("12.345", "12345.68", "123456789", "12345.6", "123.456", "12345.678"):
        assert len(re.findall(rf"(?<![\d.]){re.escape(number)}(?![\d.])", text)) >= len(controllers), number


def test_the_table_of_a_link_fits() -> None:
    summary = LinkSummary(
        realtime="SCHED_FIFO 80, memory locked (12345 MiB), no deep sleep of processors; not granted: " + FAULT[:60],
        rate_hz=12345.6, late_cycles=123_456_789, skipped_ticks=123_456_789, overshoot_p50_s=0.123456,
        overshoot_p99_s=1.23456, overshoot_max_s=12.3456, round_trip_p01_s=12.34567, round_trip_p50_s=12.34567,
        round_trip_p99_s=12.34567, round_trip_max_s=12.34567, jitter_s=1.2, sent=1,
        arrived=123_456_789, lost=123_456, loss=0.01, worst_gap_s=1.0,
        silence_at_end_s=None, interarrival_jitter_s=None, loss_bursts=123_456, longest_burst=123_456, reordered=0,
        usual_age_s=None, offset_s=None, offset_bound_s=None, clock_faults=123,
        last_clock_fault="the peer's clock was set back by 12.345 s", recorded=123_456_789, unrecorded=123_456_789,
        recording_end="no space left on the device",
    )  # fmt: skip
    text = shown(link_table(summary))
    fits(text)
    assert "12345.670 / 12345.670 / 12345.670" in text
    assert "123456 of 123580245 (1.00%)" in text


def test_the_figures_of_a_link_fit() -> None:
    figures = LinkFigures(
        mean_s=123.456789, sigma_s=123.456789, p50_s=123.456789, p99_s=123.456789, loss=0.123456, mean_burst=12345.678,
        reordered=0.123456, duplicates=0.123456, damaged=0.123456,
    )  # fmt: skip
    title = f"50000000 packets backward, seed {2**64 - 1}"
    text = shown(figures_table(title, {"asked": figures, "netem": figures, "ours": figures}))
    fits(text)
    assert text.count("123456.789 ms") == 12


def test_the_counts_of_a_proxy_fit() -> None:
    class Big(SimpleNamespace):
        def __getattr__(self, name: str) -> object:
            return {"dropped": {"loss": 10**12, "queue": 10**12}, "scheduling": "fifo"}.get(name, 0.123456)

    direction = SimpleNamespace(dropped={"loss": 10**12}, **dict.fromkeys(
        ("received", "released", "lost", "queue_full", "damaged", "extras", "overtaking", "refused", "oversize",
         "unsent"), 10**12))  # fmt: skip
    file = io.StringIO()
    statistics: Any = Big(forward=direction, backward=direction)
    print_proxy(Screen(file=file, width=WIDTH), statistics)
    table = file.getvalue().partition("dropped forward")[0]
    fits(table)
    assert table.count(str(10**12)) == 20


def test_the_table_of_a_measurement_fits(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    figures: dict[str, float | int | None] = {
        "probes": 600_000, "worst_gap_s": 12.345678, "shortest_s": 0.01, "latest_s": 0.001, "sent_forward": 600_000,
        "lost_forward": 123_456, "sent_backward": 476_544, "lost_backward": 123_456,
        **{f"{path}_{percent}_s": 12.345678 for path in ("round_trip", "forward", "backward") for percent in
           ("p50", "p99")},
    }  # fmt: skip
    Record(peer="127.0.0.1:9")._print(figures, "192.0.2.7:9200")
    text = capsys.readouterr().out
    fits(text.partition("only the sum")[0])
    assert text.count("12345.678 ms") == 7


@pytest.mark.parametrize("command", [["paper"], ["raven"], ["list"], ["netsim", "list"], ["simulate", "--list"],
                                     ["simulate", "remote_push"], ["simulate", "three_axis_box"],
                                     ["netsim", "sample", "--preset", "lte-driving"]])  # fmt: skip
def test_output_of_commands_fits(
    command: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    assert main(command) == 0
    text = capsys.readouterr().out
    fits("\n".join(line for line in text.splitlines() if not re.match(r"\s+\d+\.\d{4} s  ", line)))


def test_the_paper_has_a_line_a_row_and_its_reasons_below(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    assert main(["paper", "--json", "-"]) == 0
    captured = capsys.readouterr()
    rows = json.loads(captured.out)["rows"]
    table, _, reasons = captured.err.partition("Why they differ:")
    body = table.partition("─\n")[2].strip().splitlines()
    assert len(body) == len(rows)
    for line, row in zip(body, rows, strict=True):
        assert line.startswith(row["source"])
        assert row["ours"] is None or f"{row['ours']:.3g}" in line
        word = row["verdict"].partition(":")[0]
        assert word in line or ("not kept" in line and word == "differs")
    numbers = re.findall(r"\((\d+)\)$", "\n".join(line.rstrip() for line in body), re.MULTILINE)
    assert set(re.findall(r"^ *(\d+)\) ", reasons, re.MULTILINE)) == set(numbers)
    assert len(set(numbers)) > 5


def test_the_sensitivity_of_the_paper_fits_and_says_what_explains(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    changes: list[dict[str, float | str]] = [{"release_s": 0.085}, {"release_kind": "gain", "release_s": 0.07}]
    monkeypatch.setattr("haptether.studies.paper.sensitivity.design", lambda: changes)
    assert main(["paper", "--sensitivity", "--json", "-"]) == 0
    captured = capsys.readouterr()
    report = json.loads(captured.out)
    fits(captured.err)
    assert "moved most by" in captured.err
    assert re.search(r"Fig\. 6b .* explained \(\d+\)", captured.err)
    assert re.search(r"^Fig\. 6 +3 +0 +3 +release of the gain, release time 70 ms", captured.err, re.MULTILINE)
    assert len(report["joint_fits"]) > 5
    assert sum(row["verdict"].startswith("explained by") for row in report["rows"]) > 3


def run_of(name: str) -> Run:
    metrics = Metrics(max_ejection_velocity=1.2345e-12, peak_device_force=-1.2345e-12, ticks=10**9)
    return Run(scene=name, seed=2**64 - 1, version="0", signals=Signals({}), events=(), metrics=metrics)


def test_the_metrics_of_a_run_fit() -> None:
    file = io.StringIO()
    Simulate()._print(Screen(file=file, width=WIDTH), run_of("/a/very/long/path" * 6 + "/scene.toml"))
    assert all(cell_len(line) <= WIDTH for line in file.getvalue().splitlines())
    assert str(2**64 - 1) in file.getvalue()
    assert "-1.235e-12" in file.getvalue()


@pytest.mark.parametrize("parameters", [1, 2, 3, 8])
@pytest.mark.parametrize("width", [60, 80, 120])
def test_the_table_of_a_sweep_is_cut_nowhere(parameters: int, width: int) -> None:
    paths = [f"environment.objects.{number}.contact.static_friction_ratio" for number in range(parameters)]
    metrics = ["max_ejection_velocity", "peak_device_force", "time_to_trip_s", "false_trips", "intervention_s",
               "position_rmse_m", "force_rmse_n", "passivity_min_j"]  # fmt: skip
    columns = {
        **{path: np.array([-1.23456789e-05, 1234567.0]) for path in paths},
        "outcome": np.array(["never-engaged", "complete"]),
        **{name: np.array([np.nan, -1.2345e-12]) for name in metrics},
        "diverged": np.array([False, False]),
        "ticks": np.array([10**9, 10**9]),
        "reason": np.array(["", ""]),
    }
    file = io.StringIO()
    command = SweepCommand(scene="s")
    command._report(Screen(file=file, width=width), Sweep(columns), parameters + 1)
    text = file.getvalue()
    assert "…" not in text
    assert all(cell_len(line) <= width for line in text.splitlines())
    assert text.count("-1.235e-12") == len(metrics) - 1  # counts are whole numbers
    assert len(re.findall(r"(?<!\d)1234567(?!\d)", text)) >= parameters
    assert text.count("-1.23456789e-05") >= parameters
    assert "never-engaged" in text
    assert "2 rows: 1 never-engaged, 1 complete" in text


@pytest.mark.parametrize(
    ("label", "lines"),
    [
        ("environment.objects.0.contact.stiffness", 4),
        ("link.forward.delay_s", 3),
        ("max_ejection_velocity", 3),
        ("a.b.c.d.e.f.g.h.i.j.k.l.m.n.o.p.q.r.s.t.u.v.w.x.y.z", 4),
        ("silent [ms]", 2),
        ("", 1),
    ],
)
def test_a_label_is_folded_on_four_lines_at_most(label: str, lines: int) -> None:
    found = folded(label).split("\n")
    assert len(found) <= min(lines, 4)
    assert "".join(found).replace(" ", "") == label.replace(" ", "")


def test_columns_that_fit_are_one_table() -> None:
    columns = {"a": ["1"], "b": ["2"], "c": ["3"]}
    (one,) = of_numbers(columns, 1).blocks(80)
    assert isinstance(one, Table)
    assert len(of_numbers(columns, 1).blocks(6)) == 2


# -------------------------------------------------------------------------------------------------- text of others


def flight(text: str, *, axes: int = 1, ticks: int = 3) -> bytes:
    tick = {
        "time_s": 12345.6789, "state": "engaged", "peer": "disengaged", "age_s": 0.123456, "clutch": True, "gain": 1.0,
        "tripped": ["hsc", "wsc", "held"], "position": [-0.12345678] * axes, "command": [1.2345e-12] * axes,
        "force": [None] * axes,
    }  # fmt: skip
    return msgspec.json.encode({
        "schema": 1, "side": "master",
        "transitions": [{"time_s": 1.0, "from": "engaged", "to": "hold", "reason": text}],
        "interventions": [
            {"time_s": 1.0, "until_s": 2.0, "trips": [
                {"controller": "wsc", "observer": "E_wso [J]", "observed": -0.0312, "threshold": -0.03}]},
            {"time_s": 3.0, "until_s": 4.0, "layer": "rotation", "trips": [
                {"controller": "hsc", "observer": "S_h", "observed": 1.75, "threshold": 1.5}]},
        ],
        "interventions_seen": 40,
        "at_hold": [], "latest": [tick] * ticks,
    })  # fmt: skip


def explained(tmp_path: Path, capsys: pytest.CaptureFixture[str], body: bytes, *arguments: str) -> str:
    path = tmp_path / "master.flight"
    path.write_bytes(body)
    assert main(["explain", str(path), *arguments]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("axes", [1, 2, 3, 4, 5, 6, 7])
def test_explain_names_trips_and_cuts_no_number(
    axes: int, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    text = explained(tmp_path, capsys, flight("peer is silent " * 12, axes=axes))
    fits(text)
    assert "interventions of safety controllers: 40, of which 2 are kept:" in text
    assert "1.0000 to 2.0000 s  wsc: E_wso [J] = -0.0312, below -0.03" in text
    assert "3.0000 to 4.0000 s  rotation: hsc: S_h = 1.75, above 1.5" in text
    assert "hsc wsc held" in text
    assert text.count("-0.1235") == text.count("1.235e-12") == text.count("none") == 3 * axes
    assert "12345.6789" in text


LONG = "OSError: " + "the bus of joint 4 does not answer on /dev/serial/by-id/" + "x" * 120
CAUSES = {
    "a driver": ("slave", f"the slave has a fault: {LONG}"),
    "words": ("master", "the master has a fault: " + "its pen is not where it was " * 9),
    "a link": ("link", "nothing has arrived from 192.0.2.1:9000 for 0.1 s"),
    "hostile": ("slave", f"the slave has a fault: {HOSTILE}".replace("\ud800", "")),
}


@pytest.mark.parametrize("kind", CAUSES)
@pytest.mark.parametrize("form", ["flight", "recording"])
def test_explain_says_the_cause_in_80_columns_whatever_the_words(
    kind: str, form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    at, words = CAUSES[kind]
    step = {"at": at, "remedy": "acknowledge", "text": f"mend the cause, then acknowledge it: {words}"}
    cause = {"state": "hold", "at": at, "text": words, "steps": [step]}
    if form == "flight":
        body = json.loads(flight("peer has a fault")) | {"causes": [{"time_s": 1.5, **cause}]}
        text = explained(tmp_path, capsys, json.dumps(body).encode())
    else:
        ticks: list[dict[str, Any]] = [
            {"age_s": None, "grasp": 0.0},
            {"state": "engaged", "reason": "both sides aligned", "peer_state": "engaged"},
            {"tripped": 2, "grasp": 1.75, "trigger": 0.2, "trigger_tripped": 16.0},
            {"tripped": 18, "grasp": 9.0},
            {"tripped": 0, "trigger_tripped": 0.0, "state": "hold", "reason": "peer has a fault"},
        ]
        scene = {"run": {"seed": 0}, "safety": {"grasp_threshold": 1.5, "energy_threshold_j": -0.03}}
        path = write_recording(
            tmp_path / "one.mcap", "master", ticks, scene=scene, causes=[{"time_ns": 1_500_000_000, **cause}]
        )
        assert main(["explain", str(path)]) == 0
        text = capsys.readouterr().out
        for said in (
            "0.0020 to 0.0030 s  hsc: S_h = 1.75, above 1.5",
            "0.0020 to 0.0030 s  trigger: held on",
            "5 ticks until the last hold",
        ):
            assert said in " ".join(text.split()) or said in text, said
    fits(text)
    assert not FORBIDDEN.search(text)
    # Words longer than a line are broken, and no letter is lost.
    letters = "".join(character for character in printable(words) if not character.isspace())
    assert f"1.5000s,hold:{letters}" in "".join(text.split())
    assert f"1.mendthecause,thenacknowledgeit:{letters}" in "".join(text.split())


def test_explain_of_a_recording_without_a_tick_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_recording(tmp_path / "empty.mcap", "slave", [])
    assert main(["explain", str(path)]) == 2
    assert "slave: has no tick" in capsys.readouterr().err


@pytest.mark.parametrize("words", [LONG, "it moves 3 mm " * 20, "one two"])
def test_what_is_found_of_a_device_and_a_link_fits(
    words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    found = [Finding("close after an exception", "mend", words), Finding("time of its samples", "unseen", words)]
    console = screen()
    print_findings(console, "a-driver-of-a-long-name", found)
    assert print_verdict(console, [*found, *(Finding(f"property {number}", "unseen", "") for number in range(9))]) == 1
    fits(capsys.readouterr().out)
    reason = words[:128]
    ticks: list[dict[str, Any]] = [
        {"state": "engaged", "reason": reason},
        {"tripped": 6},
        {"state": "hold", "reason": reason},
    ]
    causes = [{"time_ns": 0, "state": "hold", "at": "slave", "text": words, "steps": []}]
    path = write_recording(tmp_path / "m.mcap", "master", [{}, *ticks], causes=causes)
    assert main(["info", str(path)]) == 0
    rest = capsys.readouterr().out
    fits(rest)
    assert "".join(words.split()) in "".join(rest.split())


def test_what_netem_does_fits(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    netem = "delay 100ms 10ms 25% loss 5% 25% duplicate 5% 50% reorder 25% 50%"
    assert main(["netsim", "compare", netem, "--packets", "2000"]) == 0
    fits(capsys.readouterr().out)


def test_explain_says_how_many_ticks_there_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    body = flight("peer is silent", ticks=50)
    assert "10 ticks until the end, of 50 that are kept" in explained(tmp_path, capsys, body)
    assert explained(tmp_path, capsys, body).count("closed") == 10
    assert explained(tmp_path, capsys, body, "--ticks", "50").count("closed") == 50


def test_explain_reads_what_an_older_version_wrote(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    body = json.loads(flight("peer is silent"))
    del body["interventions"], body["interventions_seen"]
    for tick in body["latest"]:
        del tick["tripped"]
    assert "no safety controller intervened" in explained(tmp_path, capsys, json.dumps(body).encode())


def test_a_reason_acts_on_no_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hostile = HOSTILE.replace("\ud800", "")
    text = explained(tmp_path, capsys, flight(hostile), "--json", "-")
    assert not FORBIDDEN.search(text)
    text = explained(tmp_path, capsys, flight(hostile))
    assert not FORBIDDEN.search(text)
    assert "[/nope] [red]x[/red] :smile:" in text


def test_json_on_a_terminal_is_the_same_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hostile = HOSTILE.replace("\ud800", "") + "é \U0001f600 \U000e0041"
    report = json.loads(explained(tmp_path, capsys, flight(hostile), "--json", "-"))
    assert report["transitions"][0]["reason"] == hostile


@pytest.mark.parametrize("text", [HOSTILE, "a\nb", "é ü 漢", "\U000e0041", "a\u2028b"])
def test_what_is_printable_is_one_line_that_shows(text: str) -> None:
    safe = printable(text)
    assert safe.isprintable()
    assert printable(safe) == safe
    assert printable("é ü 漢 [x] $") == "é ü 漢 [x] $"


def test_a_screen_takes_every_string_for_text() -> None:
    table = Table(HOSTILE, title=HOSTILE, caption=HOSTILE)
    table.add_row(HOSTILE)
    table.add_row(HOSTILE, style="red")
    for one in (HOSTILE, table):
        text = shown(one)
        assert not FORBIDDEN.search(text)
        assert "/nope" in text
    file = io.StringIO()
    screen = Screen(file=file, width=WIDTH, force_terminal=True, color_system=None)
    with screen.status(HOSTILE):
        pass
    # The remaining escapes are rich's own.
    assert "]0;title\x07" not in file.getvalue()


def test_a_line_of_a_run_and_its_events_act_on_no_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def once() -> Iterator[bool]:
        yield False
        yield True

    ends = once()
    finished: Callable[[], bool] = lambda: next(ends)  # noqa: E731
    monkeypatch.setattr(Stopped, "sleep", lambda _self, _seconds: None)
    wait("master", lambda: HOSTILE, finished, Stopped(), None)
    print_security([HOSTILE])
    assert not FORBIDDEN.search(capsys.readouterr().err.replace("\x1b", ""))


def test_an_error_is_one_line_that_acts_on_no_terminal(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    hostile = json.dumps("\x1b[31m\u202e[/nope]\n\x9b")
    scene.write_text(f"schema = 1\nmaster = {{ device = {hostile} }}\n", encoding="utf-8")
    links = tmp_path / "links.toml"
    links.write_text(f"schema = 1\n{hostile} = 1\n", encoding="utf-8")
    for command in (["simulate", str(scene)], ["netsim", "sample", str(links)], ["explain", "\x1b[31m\n.flight"]):
        assert main(command) in {1, 2}
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert not FORBIDDEN.search(said)


def test_only_the_screen_makes_a_console() -> None:
    folder = Path(sys.modules["haptether.cli"].__file__ or "").parent
    for path in folder.rglob("*.py"):
        if path.name != "screen.py":
            assert not re.search(r"(?<!class )\bConsole\(|from_markup|import print\b", path.read_text()), path


# -------------------------------------------------------------------------------------------------- requests


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["simulat"], "simulat: no such command: did you mean simulate?"),
        (["netsim", "smaple"], "smaple: no such command: did you mean sample?"),
        (["xyzzy"], f"xyzzy: no such command: there is {', '.join(sorted(COMMANDS))}"),
        (["--completion", "nu"], "--completion nu: must be one of bash, zsh, fish"),
        (["--completion"], "--completion: must be one of bash, zsh, fish"),
        (
            ["master", "--insecure", "--peer", "127.0.0.1:9", "--scene", "remote_push", "--set", "master.driver=tuch"],
            (
                "[master] driver = tuch: no such driver (haptether.masters): did you mean touch? there is dynamixel, "
                "force-dimension, inverse3, touch; without the key it is a model"
            ),
        ),
        (
            ["slave", "--insecure", "--listen", "127.0.0.1:0", "--scene", "remote_push", "--set", "slave.device=urr"],
            (
                "[slave] device = urr: no such driver (haptether.slaves): did you mean ur? there is simulated, "
                "dynamixel, ur"
            ),
        ),
    ],
)
def test_a_name_that_is_none_is_answered_by_the_nearest(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    assert capsys.readouterr().err == f"haptether: {said}\n"


def numbers_of(command: type[Any]) -> list[str]:
    """Return the options that take numbers, also optional or repeated ones."""
    hints = get_type_hints(command)
    scalars = {name: set(get_args(hint)) - {type(None)} or {hint} for name, hint in hints.items()}
    return [name for name, types in scalars.items() if types <= {int, float}]


REQUIRED = {
    "master": ["--peer", "127.0.0.1:9"],
    "slave": ["--listen", "127.0.0.1:0"],
    "check-link": ["--peer", "127.0.0.1:9"],
    "check-device": ["ur"],
    "identify": ["dynamixel"],
    "explain": ["master.flight"],
    "watch": ["master.sock"],
    "plot": ["master.mcap"],
    "playback": ["slave.mcap"],
    "export": ["master.mcap"],
    "sweep": ["remote_push"],
    "falsify": ["remote_push"],
    "check": ["remote_push"],
    "evaluate": ["remote_push"],
    "tune": ["master.mcap"],
}
NUMBERS = [(name, option) for name, command in COMMANDS.items() for option in numbers_of(command)]


@pytest.mark.parametrize(("command", "option"), NUMBERS)
def test_a_word_for_a_number_is_refused_in_plain_words(
    command: str, option: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    words = ["xyz"] * (6 if option in {"start", "tcp", "bias"} else 1)
    with pytest.raises(SystemExit) as ended:
        main([command, *REQUIRED.get(command, []), f"--{option.replace('_', '-')}", *words])
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert "'xyz': must be a" in said
    assert "NoneType" not in said
    assert "{None}" not in said


@pytest.mark.parametrize(
    "arguments",
    [
        ["sweep", "remote_push", "--vary", "run.seed=1,2", "--out", ""],
        ["simulate", "remote_push", "--json", ""],
        ["demo", "--out", ""],
        ["keygen", ""],
        ["plot", ""],
        ["info", ""],
        ["info", "a.mcap", ""],
    ],
)
def test_an_empty_path_is_refused_as_such(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert "'': must be a path" in capsys.readouterr().err


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_gets_a_script_that_knows_commands_and_flags(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--completion", shell]) == 0
    script = capsys.readouterr().out
    for word in ("check-link", "ur-emulator", "compare", "--encoder-quantum", "--mean-burst"):
        assert word in script or (shell == "fish" and word.removeprefix("--") in script), word
    if shell == "bash":
        subprocess.run(["bash", "-n"], input=script, text=True, check=True, timeout=30)


def test_completion_is_in_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    assert "haptether --completion bash" in capsys.readouterr().out


def test_files_of_commands_are_their_users_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    out.mkdir()
    commands = [
        ["simulate", "remote_push", "--json", "a.json", "--out", "a.npz", "--plot", "pictures", "--run.duration-s=0.2"],
        ["sweep", "paper_wall", "--vary", "safety.window=10,20", "--out", "b.csv", "--json", "b.json"],
        ["sweep", "paper_wall", "--vary", "safety.window=10,20", "--out", "b.npz"],
        ["netsim", "sample", "--delay-s", "0.01", "--packets", "10", "--csv", "c.csv", "--json", "c.json"],
        ["netsim", "proxy", "--listen", "127.0.0.1:0", "--forward", "127.0.0.1:9", "--duration-s", "0.1", "--log",
         "d.csv", "--json", "d.json"],
    ]  # fmt: skip
    flags = {"--json", "--out", "--plot", "--csv", "--log"}
    for command in commands:
        placed = [
            str(out / word) if before in flags else word for before, word in zip(["", *command], command, strict=False)
        ]
        assert main(placed) in {0, 1}, capsys.readouterr().err
    written = [path for path in out.rglob("*") if path.is_file()]
    assert len(written) == 10
    assert {stat.S_IMODE(path.stat().st_mode) for path in written} == {0o600}
    # The mask of the process changes only while a command runs.
    (tmp_path / "mine").touch()
    assert stat.S_IMODE((tmp_path / "mine").stat().st_mode) != 0o600


def test_explain_has_its_figures_in_its_help() -> None:
    assert "the last 10 of the 50 ticks" in " ".join((Explain.__doc__ or "").split())


@pytest.mark.parametrize(
    "arguments",
    [
        ["simulate", "--nope", HOSTILE],
        ["list", HOSTILE],
        ["netsim", "list", f"--{HOSTILE}"],
        ["paper", "--encoder-quantum", HOSTILE],
    ],
)
def test_arguments_that_do_not_fit_are_repeated_printably(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    said = capsys.readouterr()
    assert not FORBIDDEN.search(said.err)
    assert not FORBIDDEN.search(said.out)
    assert "x1b[31m" in said.err
