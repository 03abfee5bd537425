"""Aims of a hand in virtual time, from a table or a file."""

from pathlib import Path

import msgspec
import numpy as np
import pytest
from tests.scene.aimed import aim, aimed
from tests.scene.two_sides import reports, two_sides

from haptether.bridge import SceneError, load_scene, override_scene, save_scene, scene_json, simulate

HEADER = "time_s,x,over_s,stiffness,damping,strength_n\n"
ROWS = [aim(0.1, -0.01), aim(0.3, -0.02, over_s=0.2, strength_n=5.0), aim(0.3, 0.0, strength_n=0.0)]
LINES = "0.1,-0.01,0.1,300,8,12\n0.3,-0.02,0.2,300,8,5\n0.3,0,0.1,300,8,0\n"


def test_a_hand_without_aims_is_open() -> None:
    signals = simulate(aimed()).signals
    assert not signals.hand_force.any()
    assert np.ptp(signals.position) < 1e-4


def test_aims_in_a_row_are_the_legs_of_a_path() -> None:
    """Legs count from the engagement, aims from the start of the run."""
    ends = [0.01, -0.01, -0.03, -0.03, -0.02]
    legs = [{"duration_s": 0.2, "end": end, "shape": "linear"} for end in ends]
    led = simulate(two_sides(operator={"legs": legs}, run={"duration_s": 1.5}))
    engaged_s = reports(led)[0].engaged_s
    assert engaged_s is not None
    rows = [aim(engaged_s + 0.2 * leg, end, over_s=0.2) for leg, end in enumerate(ends)]
    held = aim(engaged_s + 0.2 * len(ends), ends[-1], over_s=0.4)
    run = simulate(override_scene(aimed(aim(0.0, 0.02), *rows, held), ["run.duration_s=1.5"]))
    until = round((engaged_s + 0.2 * len(ends) + 0.39) * 1e3)
    for name in ("position", "hand_force", "device_force", "slave_position"):
        difference = led.signals[name][:until] - run.signals[name][:until]
        assert abs(difference).max() < 1e-9, name


@pytest.mark.parametrize("opens", ["an aim without strength", "silence"])
def test_an_open_hand_throws_the_device_as_a_release_does(opens: str) -> None:
    legs = [{"duration_s": 0.3, "end": -0.045, "shape": "linear"}]
    plain = ["safety.controllers=[]", "run.duration_s=2"]
    led = simulate(two_sides(operator={"legs": legs, "release": {"at_s": 0.8, "decay_s": 0.0}}), overrides=plain)
    at_s = reports(led)[0].engaged_s
    assert at_s is not None
    rows = [aim(0.0, 0.02), aim(at_s, -0.045, over_s=0.3), aim(at_s + 0.3, -0.045), aim(at_s + 0.4, -0.045)]
    if opens != "silence":
        rows += [aim(at_s + 0.7, -0.045), aim(at_s + 0.8, 0.0, strength_n=0.0)]
    run = simulate(aimed(*rows), overrides=plain)
    peaks = [signals.velocity.max() for signals in (led.signals, run.signals)]
    assert peaks[0] > 0.2
    assert peaks[1] == pytest.approx(peaks[0], rel=1e-6)


@pytest.mark.parametrize("opens", ["an aim without strength", "silence"])
def test_each_release_by_an_aim_is_an_event_and_the_first_ends_the_false_trips(opens: str) -> None:
    # A hand that opens before the sides engage is no release.
    before = [aim(0.0, 0.02), aim(0.1, 0.02, strength_n=0.0)]
    pressing = [aim(0.1 * row, max(-0.045, 0.07 - 0.01 * row)) for row in range(5, 20)]
    last = [aim(2.0, -0.045, strength_n=0.0)] if opens != "silence" else []
    released_s = 2.0 if last else 1.9 + 0.4
    again = [*(aim(0.1 * row, 0.03 * (row % 2), over_s=0.02) for row in range(35, 40)), aim(4.0, 0.0, strength_n=0.0)]
    changes = ["run.duration_s=5", 'safety.controllers=["wsc"]']
    run = simulate(aimed(*before, *pressing, *last, *again, clutch=[[0.2, 5.0]]), overrides=changes)
    releases = [event for event in run.events if event.kind == "release"]
    assert [event.time_s for event in releases] == pytest.approx([released_s, 4.0])
    time_s, speed = run.signals["time_s"], abs(run.signals["velocity"])
    is_open = (time_s >= released_s) & (time_s <= 3.5)
    assert speed[is_open].max() > 0.1
    assert releases[0].detail == f"peak {speed[is_open].max():.3f} m/s"
    # The hand draws the device faster than it was thrown.
    assert speed[(time_s > 3.5) & (time_s < 4.0)].max() > speed[is_open].max()
    assert run.metrics.max_ejection_velocity == pytest.approx(speed[is_open].max())
    trips = [event.time_s for event in run.events if event.kind == "trip"]
    assert trips[0] > released_s
    assert run.metrics.false_trips == 0
    assert run.metrics.time_to_trip_s == pytest.approx(trips[0] - released_s)


def test_an_aim_changes_neither_clutch_nor_ladder() -> None:
    """The sides engage, hold and stop at the same ticks, whether the hand rests or moves."""
    times = ["run.duration_s=3", "link.forward.outages=[{times={kind=once, at_s=2.0, duration_s=0.15}}]"]
    still = [aim(0.3 * row, 0.02, over_s=0.3) for row in range(10)]
    moving = [aim(0.3 * row, 0.02 - 0.01 * (row % 2), over_s=0.05, strength_n=0.5 * row) for row in range(10)]
    runs = [simulate(aimed(*rows, clutch=[[0.2, 1.0], [1.3, 2.9]]), overrides=times) for rows in (still, moving)]
    for name in ("state", "slave_state"):
        np.testing.assert_array_equal(runs[0].signals[name], runs[1].signals[name])
    assert len(set(runs[0].signals.state)) > 2
    assert np.ptp(runs[1].signals.position) > 5e-3


def scene_of(folder: Path, aims: bytes | None) -> Path:
    """Write a scene that names `aims.csv` beside it."""
    if aims is not None:
        (folder / "aims.csv").write_bytes(aims)
    path = folder / "scene.toml"
    save_scene(aimed(), path)
    written = path.read_text(encoding="utf-8")
    assert "aims = {  }" in written
    path.write_text(written.replace("aims = {  }", 'aims = { file = "aims.csv" }'), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "text",
    [HEADER + LINES, "\ufeff# of a run\n" + HEADER + LINES, (HEADER + LINES).replace("\n", "\r\n")],
    ids=["plain", "mark of the byte order", "ends of Windows"],
)
def test_a_file_of_aims_is_the_table(text: str, tmp_path: Path) -> None:
    table = aimed(*ROWS)
    read = load_scene(scene_of(tmp_path, text.encode()))
    assert scene_json(read) == scene_json(table)
    save_scene(read, tmp_path / "again.toml")
    assert load_scene(tmp_path / "again.toml") == read


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "cannot be read: No such file"),
        ("", "header '': must be time_s,x,over_s,stiffness,damping,strength_n or time_s,x,y,z,over_s"),
        ("time_s,x\n0,0\n", "header 'time_s,x': must be time_s,x,over_s"),
        (HEADER.replace("over_s,stiffness", "stiffness,over_s"), "must be time_s,x,over_s"),
        (HEADER, "must have at least one row"),
        (HEADER + "0.2,0,0.1,1,1,1\n0.1,0,0.1,1,1,1\n", "row 2: time_s = 0.1: must be at least the one before it, 0.2"),
        (HEADER + "0,nan,0.1,1,1,1\n", "row 1 '0,nan,0.1,1,1,1': must be 6 finite numbers"),
        (HEADER + "0,0,0.1,1,1,51\n", "aims.csv: Expected `float` <= 50.0 - at `$.rows[0].strength_n`"),
        (HEADER + "0,2.1,0.1,1,1,1\n", "aims.csv: Expected `float` <= 2.0 - at `$.rows[0].target[0]`"),
        (
            HEADER.replace("x,", "x,y,") + "0,0,0,0.1,1,1,1\n",
            "rows.0] target = [0, 0]: must be one number or a list of 1",
        ),
    ],
)
def test_a_bad_file_of_aims_is_refused_with_its_place(text: str | None, said: str, tmp_path: Path) -> None:
    with pytest.raises(SceneError) as refused:
        load_scene(scene_of(tmp_path, None if text is None else text.encode()))
    assert said in str(refused.value)
    assert str(refused.value).count("\n") == 0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (["operator.legs=[{duration_s=1,end=0}]"], "[operator] legs: each aim replaces it"),
        (
            ["operator.recorded={time_s=[0],values=[0]}", "operator.start=0"],
            "[operator] recorded: each aim replaces it",
        ),
        (["operator.release={at_s=1}", "operator.grip_strength_n=5"], "[operator] grip_strength_n: each aim replaces"),
        (["operator.tremor={}"], "[operator] tremor: each aim replaces it"),
        (["operator.stiffness=200"], "[operator] stiffness: each aim replaces it"),
        (
            ["operator.aims.rows=[{at_s=1,target=0,strength_n=1},{at_s=0,target=0,strength_n=1}]"],
            "rows.1] at_s = 0: must be at least",
        ),
        (["operator.aims.rows=[{at_s=1,target=0,strength_n=1}]", "operator.aims.file=a.csv"], "either file, or rows"),
        (
            ["operator.aims.rows=[{at_s=1,target=[2,2],strength_n=1}]"],
            "target = [2, 2]: must be within 2 m of the origin",
        ),
        (["master.driver=touch"], "[operator] aims: aims a model: give it or [master] driver, not both"),
        (["master.kind=joints"], '[operator] aims: moves a point: kind = "linear", not "joints"'),
    ],
)
def test_a_scene_that_contradicts_its_aims_is_refused(changes: list[str], said: str) -> None:
    with pytest.raises(SceneError) as refused:
        override_scene(aimed(), changes)
    assert said in str(refused.value)


def test_aims_need_an_arm() -> None:
    scene = msgspec.structs.replace(aimed(), slave=None)
    with pytest.raises(SceneError, match="needs an arm to lead"):
        override_scene(scene, ["operator.clutch=auto"])
