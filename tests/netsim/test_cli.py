"""`haptether netsim`: its table, CSV and JSON, flags, and refusals."""

import csv
import io
import json
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np
import pytest

from haptether.cli.entry import main
from haptether.cli.netsim.link_options import LINK_FLAGS, LinkOptions
from haptether.netsim import PRESETS, LinkSettings, judge_all, link_spec


def sample(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["netsim", "sample", *arguments, "--csv", "-"]) == 0
    return capsys.readouterr().out


def rows(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


ROUGH = ("--delay-s", "0.02", "--jitter-s", "0.002", "--loss", "0.1", "--packets", "2000")


def test_flags_are_settings_of_a_link() -> None:
    assert {"preset", "delay_s", "loss", "trace"} < set(LINK_FLAGS) < set(LinkSettings.__struct_fields__)


def test_the_same_seed_gives_the_same_bytes(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    text = sample(capsys, *ROUGH, "--duplicate", "0.05", "--corrupt", "0.05")
    assert sample(capsys, *ROUGH, "--duplicate", "0.05", "--corrupt", "0.05") == text
    assert sample(capsys, *ROUGH, "--duplicate", "0.05", "--corrupt", "0.05", "--seed", "1") != text
    assert main(["netsim", "sample", *ROUGH, "--duplicate", "0.05", "--corrupt", "0.05",
                 "--csv", str(tmp_path / "a.csv")]) == 0  # fmt: skip
    assert (tmp_path / "a.csv").read_bytes() == text.encode()
    assert text.startswith("index,t_in_ns,t_out_ns,cause\n0,0,")
    found = {row["cause"] for row in rows(text)}
    assert found == {"", "loss", "duplicate", "corrupt"}
    for row in rows(text):
        assert (row["t_out_ns"] == "") == (row["cause"] == "loss")
        assert int(row["t_in_ns"]) == int(row["index"]) * 1_000_000


def test_a_copy_has_a_row_directly_after_its_packet_and_shifts_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    single, doubled = rows(sample(capsys, *ROUGH)), rows(sample(capsys, *ROUGH, "--duplicate", "0.2"))
    assert [row for row in doubled if row["cause"] != "duplicate"] == single
    places = [place for place, row in enumerate(doubled) if row["cause"] == "duplicate"]
    # 1800 packets arrive, and a fifth of them is duplicated: 360 +- 4 * 17.
    assert 290 <= len(places) <= 430
    for place in places:
        assert doubled[place]["index"] == doubled[place - 1]["index"]
        assert doubled[place - 1]["cause"] == ""


def test_the_table_sets_asked_beside_realised(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["netsim", "sample", "--delay-s", "0.05", "--jitter-s", "0.005", "--loss", "0.02", "--mean-burst", "4",
                 "--packets", "200000", "--rate", "100", "--json", "-"]  # fmt: skip
    assert main(arguments) == 0
    printed = capsys.readouterr()
    assert "realised" in printed.err
    report = json.loads(printed.out)
    asked, realised = report["asked"], report["realised"]
    assert asked == {
        "mean_s": 0.05, "sigma_s": 0.005, "p50_s": None, "p99_s": None, "loss": 0.02, "mean_burst": 4.0,
        "reordered": 0.0, "duplicates": 0.0, "damaged": 0.0,
    }  # fmt: skip
    assert realised["mean_s"] == pytest.approx(0.05, rel=0.02)
    assert realised["sigma_s"] == pytest.approx(0.005, rel=0.02)
    assert realised["p99_s"] == pytest.approx(0.05 + 2.3263 * 0.005, rel=0.02)
    # 1000 bursts have mean 4 and deviation 3.5: allow four deviations of their mean, and of their number.
    assert realised["mean_burst"] == pytest.approx(4.0, abs=4 * 3.5 / np.sqrt(1000))
    assert realised["loss"] == pytest.approx(0.02, rel=0.2)
    assert (realised["reordered"], realised["duplicates"], realised["damaged"]) == (0.0, 0.0, 0.0)


def test_a_sample_is_that_of_the_library(capsys: pytest.CaptureFixture[str]) -> None:
    text = sample(capsys, "--preset", "lte-driving", "--direction", "backward", "--seed", "5", "--packets", "500")
    sent = np.arange(500, dtype=np.int64) * 1_000_000
    verdicts = judge_all(PRESETS["lte-driving"].backward, sent, direction="backward", seed=5, sizes=92)
    assert [int(row["t_out_ns"] or -1) for row in rows(text)] == verdicts.t_out_ns.tolist()
    assert [row["cause"] for row in rows(text)] == verdicts.causes


class Flags(TypedDict, total=False):
    """Some of the flags."""

    delay_s: float
    loss: float
    seed: int
    set: tuple[str, ...]
    backward_set: tuple[str, ...]


def specs(scene: str | None = None, **flags: Unpack[Flags]) -> tuple[dict[str, Any], dict[str, Any], int]:
    links = LinkOptions(**flags).links(scene)
    return link_spec(links.forward, "forward"), link_spec(links.backward, "backward"), links.seed


def test_the_backward_direction_is_as_forward_unless_it_differs() -> None:
    forward, backward, seed = specs(delay_s=0.05, loss=0.01)
    assert forward == backward
    assert (forward["delay_s"], forward["loss"], seed) == (0.05, 0.01, 0)
    forward, backward, _ = specs(delay_s=0.05, backward_set=("delay-s=0.1", "queue-packets=5", "rate_bps=1e6"))
    assert (forward["delay_s"], forward["rate_bps"]) == (0.05, None)
    assert (backward["delay_s"], backward["rate_bps"], backward["queue_packets"]) == (0.1, 1e6, 5)
    forward, backward, _ = specs(set=("keep_order=false",), backward_set=("distribution=gamma",))
    assert (forward["keep_order"], backward["keep_order"]) == (False, False)
    assert (forward["distribution"], backward["distribution"]) == ("normal", "gamma")


def test_a_scene_gives_its_links_and_its_seed(tmp_path: Path) -> None:
    forward, backward, seed = specs("remote_push", loss=0.5)
    assert (forward["delay_s"], forward["loss"], seed) == (0.05, 0.5, 1)
    assert backward == forward
    assert specs("remote_push", seed=9)[2] == 9
    mine = tmp_path / "mine.toml"
    mine.write_text("schema = 1\nseed = 3\n[link.forward]\ndelay_s = 0.1\n")
    forward, backward, seed = specs(str(mine))
    assert (forward["delay_s"], backward["delay_s"], seed) == (0.1, 0.0, 3)


def test_files_lie_beside_the_scene(tmp_path: Path) -> None:
    (tmp_path / "delays.csv").write_text("time_s,delay_s\n0,0.1\n1,\n2,0.3\n")
    (tmp_path / "line.up").write_text("1\n1\n5\n")
    (tmp_path / "mine.dist").write_text("# a table\n-8192 0 8192\n")
    mine = tmp_path / "mine.toml"
    mine.write_text(
        'schema = 1\n[link.forward]\ntrace = { file = "delays.csv", interpolate = false }\n'
        'opportunities = { file = "line.up" }\n'
        '[link.backward]\ndelay_s = 0.05\njitter_s = 0.001\ndistribution = "mine.dist"\n'
    )
    forward, backward, _ = specs(str(mine))
    assert forward["trace"] == {
        "time_s": [0.0, 1.0, 2.0], "delay_s": [0.1, None, 0.3], "interpolate": False, "repeat": True,
    }  # fmt: skip
    assert forward["opportunities"] == {"time_ms": [1, 1, 5]}
    assert backward["distribution"] == {"table": [-8192, 0, 8192]}


@pytest.mark.parametrize("first_s", [0, 0.25, 3600, 1_700_000_000, -5])
@pytest.mark.parametrize("how", ["flag", "inline", "file"])
def test_a_recording_begins_at_its_first_record(
    first_s: float, how: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    times = [first_s + 0.01 * step for step in range(100)]
    delays = [0.001 * (1 + step) for step in range(100)]
    rows = "".join(f"{time},{delay}\n" for time, delay in zip(times, delays, strict=True))
    (tmp_path / "a.csv").write_text(f'"time_s","delay_s"\n{rows}')
    if how == "inline":
        if not 0 <= first_s <= 1e9:
            pytest.skip("a scene has times from 0 to 1e9 s")
        table = f"trace = {{ time_s = {times}, delay_s = {delays} }}"
    else:
        table = 'trace = { file = "a.csv" }'
    scene = tmp_path / "mine.toml"
    scene.write_text(f"schema = 1\n[link.forward]\n{table}\n")
    given = ["--trace", str(tmp_path / "a.csv")] if how == "flag" else [str(scene)]
    assert main(["netsim", "sample", *given, "--packets", "990", "--rate", "1000", "--json", "-"]) == 0
    realised = json.loads(capsys.readouterr().out)["realised"]
    # Each delay acts for its 10 ms; a constant delay would have no deviation.
    assert realised["mean_s"] == pytest.approx(0.05, abs=0.002)
    assert realised["sigma_s"] > 0.02


@pytest.mark.parametrize("one_way", [True, False])
def test_half_round_trips_of_irtt_are_said_to_be_that(
    one_way: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    delay = {"rtt": 40_000_000} | ({"send": 10_000_000, "receive": 30_000_000} if one_way else {})
    trips = [{"seqno": number, "lost": "false", "delay": delay} for number in range(3)]
    path = tmp_path / "measured.json"
    path.write_text(json.dumps({"config": {"params": {"interval": 10_000_000}}, "round_trips": trips}))
    assert main(["netsim", "sample", "--trace", str(path), "--packets", "10"]) == 0
    said = capsys.readouterr().out
    assert ("link.forward.trace: half of each round trip" in said) is not one_way
    links = LinkOptions(trace=path).links(None)
    forward, backward = link_spec(links.forward, "forward"), link_spec(links.backward, "backward")
    assert forward["trace"]["delay_s"] == [0.01 if one_way else 0.02] * 3
    assert backward["trace"]["delay_s"] == [0.03 if one_way else 0.02] * 3


@pytest.mark.parametrize(
    ("file", "setting", "said"),
    [
        (
            ("a.csv", "time_s,delay_s\n0,0.1\n1,x\n"),
            'trace = { file = "a.csv" }',
            "trace.file: {path}: line 3, column 3: ",
        ),
        (("a.csv", "time_s\n"), 'trace = { file = "a.csv" }', "trace.file: {path}: line 1, column 1: "),
        (("a.json", "{"), 'trace = { file = "a.json" }', "trace.file: {path}: line 1, column "),
        (("a.up", "1\n2\n1\n"), 'opportunities = { file = "a.up" }', "opportunities.file: {path}: line 3, column 1: "),
        (("a.dist", "1 2 three\n"), 'distribution = "a.dist"', "distribution: {path}: line 1, column 5: "),
        (("b.csv", ""), 'trace = { file = "a.csv" }', "trace.file: {folder}/a.csv: cannot be read: No such file"),
        (("a.csv", ""), 'trace = { file = "a.csv", time_s = [0.0] }', "trace.file: either file, or time_s and delay_s"),
    ],
)
def test_a_bad_file_says_where(
    file: tuple[str, str], setting: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, text = file
    (tmp_path / name).write_text(text)
    scene = tmp_path / "mine.toml"
    scene.write_text(f"schema = 1\n[link.forward]\n{setting}\n")
    assert main(["netsim", "sample", str(scene)]) == 2
    stderr = capsys.readouterr().err
    said = said.format(path=tmp_path / name, folder=tmp_path)
    assert stderr.startswith("haptether: [link.forward")
    assert said.partition(".file")[2] in stderr
    assert stderr.count("\n") == 1


def test_a_file_that_is_too_large_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with (tmp_path / "a.csv").open("wb") as file:
        file.truncate(2**28 + 1)
    scene = tmp_path / "mine.toml"
    scene.write_text('schema = 1\n[link.forward]\ntrace = { file = "a.csv" }\n')
    assert main(["netsim", "sample", str(scene)]) == 2
    assert "a.csv: more than 268435456 bytes" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--delay-s", "-1"], "[link.forward] delay_s = -1: must be 0 to 3600"),
        (["--loss", "nan"], "[link.forward] loss = nan: must be a finite number"),
        (["--loss", "0.9", "--mean-burst", "1.5"], "[link.forward] mean_burst"),
        (["--preset", "starlnk"], '[link.forward] preset = "starlnk": must be one of wired-lan, '),
        (["--distribution", "norml"], '[link.forward] distribution = "norml": must be one of normal, '),
        (["--backward.delay-s", "-1"], "[link.backward] delay_s = -1: must be 0 to 3600"),
        (["--backward.dela-s", "1"], "[link.backward] has no key dela_s: did you mean delay_s?"),
        (["--set", "delay_s"], "must be table.key=value"),
        (["--seed", "-1"], "seed = -1: must be between 0 and 2^64 - 1"),
        (["--packets", "0"], "packets = 0: must be 1 to 5e+07"),
        (["--rate", "inf"], "rate = inf: must be 0.001 to 1e+09"),
        (["--delay-s", "0.1", "--set", "delay-s=0.2"], "--delay-s, --set delay_s: one setting is given twice"),
        (["--trace", "a.csv", "--set", "trace.file=b.csv"], "--trace, --set trace.file: one setting is given twice"),
        (["--set", "loss=0.1", "--set", "loss=0.2"], "--set loss, --set loss: one setting is given twice"),
        (["--backward.loss", "0", "--backward-set", "loss=1"], "--backward.loss, --backward-set loss: one setting"),
        (["--columns", "1"], "--columns 1: no picture is asked for: give --plot, too"),
        (["--csv", "-", "--json", "-"], "csv, json: only one of the two"),
        (["--csv", "one", "--json", "./one"], "one: is to be written twice: give two files"),
        (["remote_psh"], "remote_psh: no shipped scene and no such file: did you mean remote_push?"),
    ],
)
def test_a_bad_request_is_one_line_and_status_2(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["netsim", "sample", *arguments]) == 2
    stderr = capsys.readouterr().err
    assert said in stderr
    assert stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("schema = 2\n", "mine.toml: schema = 2: must be 1"),
        ("schema = 1\nsede = 3\n", "mine.toml: sede: a file of links has only schema, title, shows, seed and [link.*]"),
        ("schema = 1\nseed = 1.5\n", "mine.toml: seed = 1.5: must be a whole number"),
        ("schema = 1\n[link.forwards]\n", "[link] has no key forwards: did you mean forward?"),
        ("schema = 1\n[link\n", "mine.toml: "),
    ],
)
def test_a_bad_file_of_links_is_refused(
    text: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.toml").write_text(text)
    assert main(["netsim", "sample", str(tmp_path / "mine.toml")]) == 2
    assert said in capsys.readouterr().err


def test_an_unwritable_target_is_status_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["netsim", "sample", "--csv", str(tmp_path / "missing" / "a.csv")]) == 1
    assert "cannot be written" in capsys.readouterr().err


def test_the_presets_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["netsim", "list", "--json", "-"]) == 0
    printed = capsys.readouterr()
    report = json.loads(printed.out)
    assert list(report) == list(PRESETS)
    assert report["starlink"]["forward"]["slots"]["period_s"] == 15.0
    for preset in PRESETS.values():
        assert preset.source.split()[0] in printed.err


def test_the_picture_is_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "sample.png"
    assert main(["netsim", "sample", *ROUGH, "--plot", str(picture)]) == 0
    assert str(picture.name) in "".join(capsys.readouterr().out.split())
    assert picture.stat().st_size > 10_000
