"""`haptether.load`: a recorded run has the names, shapes, codes and events of a run in virtual time."""

import errno
import pickle
import time
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any, Literal, cast

import msgspec
import numpy as np
import pytest
from mcap.writer import CompressionType
from tests.recording.files import BEGUN_NS, write_recording

import haptether
from haptether.bridge import Event, LiveMaster, LiveSlave, load, load_scene, read_recording, scene_json, simulate

ENGAGED = {"state": "engaged", "reason": "both sides aligned"}


def test_signals_have_the_names_shapes_and_codes_of_virtual_time(tmp_path: Path) -> None:
    ticks: list[dict[str, Any]] = [
        {"position": [0.1], "true_position": [0.11], "device_force": [-2.0], "age_s": None, "hand_force": [1.5]},
        ENGAGED | {"tripped": 4, "peer_state": "engaged", "acted": 3, "age_s": 0.25},
        {"state": "hold", "tripped": 0, "clutch": True},
    ]
    run = load(write_recording(tmp_path / "one.mcap", "master", ticks))
    signals = run.signals
    np.testing.assert_array_equal(signals.time_s, [0.0, 0.001, 0.002])
    np.testing.assert_array_equal(signals.position, [0.11] * 3)
    np.testing.assert_array_equal(signals.measured_position, [0.1] * 3)
    np.testing.assert_array_equal(signals.device_force, [-2.0] * 3)
    np.testing.assert_array_equal(signals.state, np.array([0, 2, 4], dtype=np.uint8))
    np.testing.assert_array_equal(signals.peer_state, [255, 2, 2])
    np.testing.assert_array_equal(signals.tripped, np.array([0, 4, 0], dtype=np.uint8))
    np.testing.assert_array_equal(signals.acted, [0, 3, 3])
    np.testing.assert_array_equal(signals.age_s, [np.nan, 0.25, 0.25])
    assert {signals[name].dtype for name in ("state", "tripped", "acted")} == {np.dtype(np.uint8)}
    assert (run.scene, run.seed, run.version) == ("one", 7, "0.1.0")
    assert run.settings == {"schema": 1, "run": {"seed": 7}}


def test_what_was_not_there_is_left_out(tmp_path: Path) -> None:
    master = load(write_recording(tmp_path / "m.mcap", "master", [{}, {}]))
    assert not {"hand_force", "trigger", "security"} & set(master.signals)
    slave = load(write_recording(tmp_path / "s.mcap", "slave", [{}, {}]))
    assert not {"gripper", "gripper_command", "gripper_force", "holds_object"} & set(slave.signals)
    ticks: list[dict[str, Any]] = [{"gripper": 0.0}, {"holds_object": True}, {"holds_object": False}]
    gripped = load(write_recording(tmp_path / "g.mcap", "slave", ticks))
    np.testing.assert_array_equal(gripped.signals.holds_object, [False, True, False])
    assert [(event.time_s, event.kind) for event in gripped.events] == [(0.001, "grip"), (0.002, "drop")]


def test_several_axes_and_turns(tmp_path: Path) -> None:
    here = [1.0, 0.0, 0.0, 0.0]
    there = [np.cos(0.5), np.sin(0.5), 0.0, 0.0]
    ticks: list[dict[str, Any]] = [
        {
            "position": [1.0, 2.0, 3.0], "true_position": [1.0, 2.0, 3.0], "device_force": [3.0, 0.0, -4.0],
            "orientation": here, "true_orientation": there, "device_torque": [0.0, 0.3, 0.4], "rotation_tripped": 0,
        },
        ENGAGED | {"rotation_tripped": 1},
    ]  # fmt: skip
    run = load(write_recording(tmp_path / "pose.mcap", "master", ticks))
    assert run.signals.position.shape == (2, 3)
    np.testing.assert_array_equal(run.signals.orientation[0], there)
    np.testing.assert_array_equal(run.signals.measured_orientation[0], here)
    assert (run.metrics.peak_device_force, run.metrics.peak_device_torque) == (5.0, 0.5)
    assert Event(0.001, "trip", "vfc") in run.events
    columns = run.columns()
    assert [name for name in columns if name.startswith("orientation")] == [f"orientation_{axis}" for axis in "wxyz"]
    np.testing.assert_array_equal(columns["device_force_z"], [-4.0, -4.0])


def test_events_are_those_of_both_sides_in_the_order_of_time(tmp_path: Path) -> None:
    master = write_recording(
        tmp_path / "m.mcap",
        "master",
        [{}, {"state": "aligning", "reason": "clutch pressed after a release"}, ENGAGED, {"tripped": 4},
         {"tripped": 6}, {"tripped": 0}, {"trigger_tripped": 1.0}, {"trigger_tripped": None}],
        causes=[{"time_ns": 9_000_000, "state": "hold", "at": "slave", "text": "the tool touches", "steps": []}],
    )  # fmt: skip
    slave = write_recording(
        tmp_path / "s.mcap", "slave", [{}, ENGAGED, {"state": "hold", "reason": "peer silent too long"}],
        begun_ns=BEGUN_NS + 2_500_000,
    )  # fmt: skip
    events = load(master, slave).events
    assert [(round(event.time_s, 4), event.kind, event.detail) for event in events] == [
        (0.001, "aligning", "master: clutch pressed after a release"),
        (0.002, "engaged", "master: both sides aligned"),
        (0.003, "trip", "wsc"),
        (0.0035, "engaged", "slave: both sides aligned"),
        (0.0045, "hold", "slave: peer silent too long"),
        (0.005, "recover", ""),
        (0.006, "trip", "trigger vfc"),
        (0.007, "recover", "trigger"),
        (0.009, "cause", "slave: the tool touches"),
    ]


def test_the_slave_is_put_on_the_masters_time(tmp_path: Path) -> None:
    master = write_recording(tmp_path / "m.mcap", "master", [{}] * 5)
    slave = write_recording(tmp_path / "s.mcap", "slave", [{}] * 5, begun_ns=BEGUN_NS - 1_250_000)
    for both in (load(master, slave), load(slave, master)):
        np.testing.assert_allclose(both.signals.slave_time_s, np.arange(5) * 1e-3 - 1.25e-3, atol=1e-12)
        np.testing.assert_allclose(both.signals.time_s, np.arange(5) * 1e-3, atol=1e-12)
    moved = load(master, slave, slave_begun_s=0.5)
    np.testing.assert_allclose(moved.signals.slave_time_s, 0.5 + np.arange(5) * 1e-3, atol=1e-12)


def test_two_files_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    master = write_recording(tmp_path / "m.mcap", "master", [{}] * 5)
    with pytest.raises(ValueError, match="m, m: both are of the master, must be one of each side"):
        load(master, master)
    later = write_recording(tmp_path / "later.mcap", "slave", [{}] * 5, begun_ns=BEGUN_NS + 10**10)
    with pytest.raises(ValueError, match=r"from 10\.000 to 10\.004 s of the master's time, whose own ends at 0\.004 s"):
        load(master, later)
    with pytest.raises(ValueError, match=r"slave_begun_s = 0\.1: only m was given"):
        load(master, slave_begun_s=0.1)


@pytest.mark.parametrize(
    ("ticks", "outcome", "intervention_s"),
    [
        ([{}, {}], "never-engaged", 0.0),
        ([ENGAGED, {"tripped": 4}, {}, {"tripped": 0}, {}], "complete", 0.002),
        ([ENGAGED, {"state": "hold"}], "hold", 0.0),
    ],
)
def test_metrics_are_those_that_need_no_model(
    tmp_path: Path, ticks: list[dict[str, Any]], outcome: str, intervention_s: float
) -> None:
    metrics = load(write_recording(tmp_path / "m.mcap", "master", ticks)).metrics
    assert (metrics.outcome, metrics.ticks) == (outcome, len(ticks))
    assert metrics.intervention_s == pytest.approx(intervention_s, abs=1e-12)
    assert metrics.max_ejection_velocity is None, "when the hand let go is not known"


def test_a_file_without_a_scene_or_cut_off_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    bare = load(write_recording(tmp_path / "bare.mcap", "master", [{}], scene=None))
    assert (bare.settings, bare.version, bare.seed) == ({}, "", 0)
    whole = write_recording(tmp_path / "m.mcap", "master", [{}] * 2000)
    cut, content = tmp_path / "cut.mcap", whole.read_bytes()
    assert read_recording(whole).whole
    lengths = [0]
    for share in np.linspace(0.05, 0.95, 40):
        cut.write_bytes(content[: int(share * len(content))])
        assert not read_recording(cut).whole
        lengths.append(len(load(cut).signals.time_s))
    assert sorted(lengths) == lengths, "more of the file, no fewer ticks"
    assert 1000 < lengths[-1] <= 2000
    empty = load(write_recording(tmp_path / "empty.mcap", "master", []))
    assert (len(empty.signals.time_s), empty.events, empty.metrics.outcome) == (0, (), "never-engaged")


def test_a_file_that_is_cut_off_or_changed_early_is_refused_in_a_word(tmp_path: Path) -> None:
    content = write_recording(tmp_path / "m.mcap", "master", [{}]).read_bytes()
    described = content.index(b"haptether.master")
    for text, bytes_ in {
        "no recording of Haptether": content[:20],
        "was cut off before its first tick": content[:described],
        "its chunks are compressed": write_recording(
            tmp_path / "z.mcap", "master", [{}], compression=CompressionType.ZSTD
        ).read_bytes(),
    }.items():
        (path := tmp_path / "changed.mcap").write_bytes(bytes_)
        with pytest.raises(ValueError, match=text):
            read_recording(path)
    for path, error in {tmp_path / "none": FileNotFoundError, tmp_path: IsADirectoryError}.items():
        with pytest.raises(error) as raised:
            read_recording(path)
        assert (raised.value.filename, raised.value.errno) == (path, errno_of(path))
        assert "must be what --record of master, slave or simulate wrote" in str(raised.value)
    # If another file would not help, the message does not ask for one.
    with pytest.raises(NotADirectoryError) as raised:
        read_recording(tmp_path / "m.mcap" / "below")
    assert "must be" not in str(raised.value)


def errno_of(path: Path) -> int:
    return errno.EISDIR if path.is_dir() else errno.ENOENT


def test_tables_hold_what_the_signals_hold() -> None:
    run = simulate("ur_pick", overrides=["run.duration_s=0.3"])
    sides: tuple[tuple[Literal["master", "slave"], str], ...] = (("master", "time_s"), ("slave", "slave_time_s"))
    for side, times in sides:
        columns = run.columns(side)
        assert {len(column) for column in columns.values()} == {len(run.signals[times])}
        polars, pandas = run.to_polars(side), run.to_pandas(side)
        assert polars.columns == list(columns)
        assert pandas.index.name == times
        for name, column in columns.items():
            np.testing.assert_array_equal(polars[name].to_numpy(), column)
            np.testing.assert_array_equal(pandas.reset_index()[name].to_numpy(), column)
    assert not set(run.columns("master")) & set(run.columns("slave"))
    dataset = run.to_xarray()
    assert set(dataset.data_vars) | {"time_s", "slave_time_s"} == set(run.signals)
    np.testing.assert_array_equal(dataset["slave_position"].sel(axis="z"), run.signals.slave_position[:, 2])
    np.testing.assert_array_equal(dataset["orientation"].sel(quaternion="w"), run.signals.orientation[:, 0])
    assert dataset["slave_position"].dims == ("slave_time_s", "axis")


def test_a_side_that_was_not_recorded_is_named(tmp_path: Path) -> None:
    run = load(write_recording(tmp_path / "m.mcap", "master", [{}]))
    with pytest.raises(ValueError, match="side = 'slave': was not recorded; there is 'master'"):
        run.columns("slave")
    scene = msgspec.structs.replace(load_scene("remote_push", ["run.duration_s=0.1"]), record=None)
    with pytest.raises(ValueError, match=r"there is none: no \[record\]"):
        simulate(scene).columns()


def test_a_notebook_shows_metrics_and_charts(tmp_path: Path) -> None:
    page = simulate("remote_push", overrides=["run.duration_s=0.5"])._repr_html_()
    root = ET.fromstring(page)
    assert len(root.findall(".//svg")) == 4, "position, force on the hand, arm, force on the tool"
    assert "largest device force [N]" in {"".join(cell.itertext()) for cell in root.iter() if cell.tag in ("td", "th")}
    named = load(write_recording(tmp_path / "<b>.mcap", "master", [{}, {"position": [None], "true_position": [None]}]))
    assert "<b>.mcap" not in named._repr_html_()
    ET.fromstring(named._repr_html_())


def test_a_spike_of_one_tick_is_in_the_chart(tmp_path: Path) -> None:
    quiet = [{"device_force": [0.0]}] * 1000
    ticks = [*quiet, {"device_force": [7.0]}, {"device_force": [0.0]}, *quiet]
    spike = load(write_recording(tmp_path / "m.mcap", "master", ticks))
    assert "force on the hand [N]: 0 to 7" in spike._repr_html_()


def test_a_run_says_what_was_set_and_can_be_pickled() -> None:
    run = haptether.simulate("remote_push", overrides=["run.duration_s=0.1", "safety.window=77"])
    assert run.settings["safety"]["window"] == 77
    copy = pickle.loads(pickle.dumps(run))
    assert copy.settings == run.settings


@pytest.mark.parametrize("path", [3, "", None, True, b"a.mcap"])
def test_what_is_no_path_is_refused(path: object) -> None:
    for read in (load, read_recording):
        with pytest.raises(ValueError, match=rf"^recording = {path!r}: must be the path of what --record of master"):
            read(cast("Any", path))


@pytest.mark.live
@pytest.mark.parametrize("name", ["remote_push", "pick_and_place"])
def test_a_live_run_loads_as_the_scene_that_it_ran(name: str, tmp_path: Path) -> None:
    specification = scene_json(load_scene(name))
    key = bytes(range(32))
    slave_path, master_path = tmp_path / "slave.mcap", tmp_path / "master.mcap"
    how: dict[str, Any] = {"key": key, "min_free_bytes": 0}
    slave = LiveSlave(specification, listen="127.0.0.1:0", run_id=2, record=slave_path, **how)
    master = LiveMaster(specification, peer=slave.address, run_id=1, record=master_path, **how)
    end_s = time.monotonic() + 20.0
    while (master.state, slave.state) != ("engaged", "engaged"):
        assert time.monotonic() < end_s, (master.state, slave.state)
        time.sleep(0.01)
    time.sleep(0.3)
    trace, _ = master.finish()
    slave.finish()
    run = load(master_path, slave_path)
    assert run.specification == specification
    assert run.version == haptether.__version__
    np.testing.assert_array_equal(run.signals.device_force, trace.device_force)
    there = simulate(name, overrides=["run.duration_s=0.2"]).signals
    of_the_truth = {signal for signal in there if signal.startswith(("body_", "handle_", "hole_", "finger_"))}
    missing = set(there) - set(run.signals) - of_the_truth
    assert missing <= {"hand_force", "hand_torque"}, "which were 0 so early"
    for signal in set(there) & set(run.signals):
        assert run.signals[signal].shape[1:] == there[signal].shape[1:], signal
        assert run.signals[signal].dtype == there[signal].dtype or signal == "holds_object", signal
    engaged = {event.detail.partition(":")[0]: event.time_s for event in run.events if event.kind == "engaged"}
    assert set(engaged) == {"master", "slave"}
    # Both sides run on one machine: they differ by a frame and by stalls of the machine.
    assert abs(engaged["master"] - engaged["slave"]) < 0.2
