"""Figures: all drawn content is visible for any run; colours, sizes and fonts follow the style."""

import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from msgspec import inspect
from tests.view.figures import check, event_names, texts_of

import haptether
from haptether.bridge import Event, Metrics, Run, Scene, Signals
from haptether.bridge.scene.errors import members
from haptether.bridge.scene.labels import label_of, labels_of
from haptether.studies import DemoScene, draw_paper, paper_sensitivity, reproduce_paper
from haptether.studies.demo import draw_demo
from haptether.studies.remote_push import PushResult
from haptether.view.figures.intervals import mean_and_half, student_quantile
from haptether.view.figures.link import draw_link
from haptether.view.figures.run import draw_run
from haptether.view.figures.sweep import draw_sweep
from haptether.view.style.colours import CONTROLLERS, PAPER, SIGNALS, UNION, controller_look, controller_title
from haptether.view.style.figure import (
    WIDTHS_IN,
    Columns,
    PictureStyle,
    new_figure,
    picture_style,
    styled,
    write_figure,
)
from haptether.view.style.series import envelope

pytestmark = pytest.mark.slow

RAW = re.compile(r"[a-z]_[a-z]|[a-z]\.[a-z]")
"""Key of a scene or metric."""
LONG = "master: the peer has been silent for 20 ms, for a reason that takes a whole line to say; $\\frac{1}{0}$"


def run_of(ticks: int, *, axes: int | None = None, events: tuple[Event, ...] = (), flat: bool = False) -> Run:
    shape = (ticks,) if axes is None else (ticks, axes)
    noise = np.random.default_rng(1).normal(size=shape)
    tripped = np.zeros(ticks, np.uint8)
    for event in events:
        tripped[min(ticks - 1, int(event.time_s * 1e3))] |= 4
    signals: dict[str, npt.NDArray[Any]] = {
        "time_s": np.arange(ticks) * 1e-3,
        "position": np.full(shape, 0.5) if flat else np.cumsum(noise, axis=0) * 1e-5,
        "velocity": np.zeros(shape) if flat else noise,
        "device_force": np.zeros(shape) if flat else noise,
        "rendered_force": np.zeros(shape) if flat else 2.0 * noise,
        "state": np.full(ticks, 2, np.uint8),
        "tripped": tripped,
    }
    return Run(scene="a run", seed=2**64 - 1, version="0", signals=Signals(signals), events=events, metrics=Metrics())


CLOSE = tuple(Event(0.5 + 0.004 * n, ("trip", "hold", "contact")[n % 3], ("wsc", LONG, "")[n % 3]) for n in range(40))
AT_THE_END = tuple(Event(1.99 + 0.001 * n, "hold", LONG) for n in range(5))
AWKWARD = {
    "many trips close together": run_of(2000, events=CLOSE),
    "at the end": run_of(2000, events=AT_THE_END),
    "three axes": run_of(2000, axes=3, events=CLOSE[:4]),
    "seven joints": run_of(2000, axes=7),
    "one tick": run_of(1),
    "one tick, an event": run_of(1, events=(Event(0.0, "trip", "wsc"),)),
    "nothing happens": run_of(2000, flat=True),
    "long": run_of(60_000, axes=3),
}


@pytest.mark.sampled(4)
@pytest.mark.parametrize(
    ("name", "columns"), [*((name, 1) for name in AWKWARD), ("many trips close together", 2), ("at the end", 2)]
)
def test_no_label_of_a_run_falls_off_or_overlaps(name: str, columns: Columns) -> None:
    check(draw_run(AWKWARD[name], columns))


@pytest.mark.parametrize(
    ("scene", "columns"), [("remote_push", 1), ("remote_push", 2), ("ur_peg", 1), ("felt_trigger", 2), ("gripper", 1)]
)
def test_no_label_of_a_scene_falls_off_or_overlaps(scene: str, columns: Columns) -> None:
    check(haptether.simulate(scene).plot(columns=columns))


def test_events_are_named_or_counted() -> None:
    figure = draw_run(AWKWARD["many trips close together"])
    named = event_names(figure)
    left_out = re.search(r"\((\d+) more events", figure.axes[-1].get_xlabel())
    assert left_out is not None
    assert len(named) + int(left_out[1]) == len(CLOSE)
    assert len(event_names(draw_run(AWKWARD["at the end"]))) == len(AT_THE_END)


def test_three_axes_are_a_norm_and_components() -> None:
    run = AWKWARD["three axes"]
    labels = {panel.get_ylabel().replace("\n", " "): panel for panel in draw_run(run).axes}
    assert list(labels)[:4] == ["|x - x(0)| [m]", "position [m]", "|velocity| [m/s]", "velocity [m/s]"]
    norm = labels["|velocity| [m/s]"].get_lines()[0].get_ydata()
    assert np.asarray(norm) == pytest.approx(np.linalg.norm(run.signals.velocity, axis=1))
    assert len([line for line in labels["velocity [m/s]"].get_lines() if str(line.get_label()) in "xyz"]) == 3


def test_a_spike_of_one_tick_survives_a_long_run() -> None:
    values = np.zeros(1_000_000)
    values[123_457], values[800_001] = 5.0, -7.0
    time_s, drawn = envelope(np.arange(1_000_000.0) * 1e-3, values)
    assert len(drawn) < 10_000
    assert (drawn.max(), drawn.min()) == (5.0, -7.0)
    assert time_s[np.argmax(drawn)] == pytest.approx(123.457)
    assert np.all(np.diff(time_s) > 0.0)


# --------------------------------------------------------------------------------------------------- sweeps, links


def sweep_of(**varied: npt.NDArray[np.float64]) -> dict[str, npt.NDArray[Any]]:
    grids = [grid.ravel() for grid in np.meshgrid(*varied.values(), indexing="ij")]
    columns: dict[str, npt.NDArray[Any]] = dict(zip(varied, grids, strict=True))
    noise = np.random.default_rng(2).normal(size=len(grids[0]))
    speed = grids[0] + 0.1 * noise
    speed[0] = np.nan
    return columns | {"max_ejection_velocity": speed, "peak_device_force": 1e-4 + 0.0 * speed,
                      "false_trips": np.zeros(len(speed)), "diverged": np.zeros(len(speed), bool)}  # fmt: skip


TEN = np.linspace(0.01, 0.1, 10)


@pytest.mark.parametrize("style", ["screen", "paper"])
@pytest.mark.parametrize("varied", [{"a": TEN}, {"a": TEN[:1]}, {"a": TEN, "run.seed": np.arange(5.0)},
                                    {"link.forward.delay_s": TEN, "safety.window": np.array([50.0, 100.0, 1e3])},
                                    {"a": TEN[:1], "b": TEN[:1]}, {"a": TEN, "b": TEN, "run.seed": np.arange(3.0)},
                                    {"run.seed": np.arange(4.0)}])  # fmt: skip
def test_no_label_of_a_sweep_falls_off_or_overlaps(varied: dict[str, Any], style: PictureStyle) -> None:
    columns = sweep_of(**varied)
    for width in (1, 2) if len(varied) == 2 else (2,):
        with picture_style(style):
            figure = draw_sweep("remote_push", columns, list(varied), width, labels_of(columns))
        check(figure)
        assert [text.get_text() for text in texts_of(figure) if RAW.search(text.get_text())] == (
            [] if style == "paper" else [figure.get_suptitle()]
        )


def test_a_field_has_a_label_in_words_with_its_unit() -> None:
    for path, values, text, factor in (
        ("link.forward.delay_s", [0.01, 0.1], "forward delay [ms]", 1e3),
        ("link.forward.delay_s", [0.1, 1.0], "forward delay [s]", 1.0),
        ("safety.energy_threshold_j", [-0.03], "energy threshold [mJ]", 1e3),
        ("safety.hsc_force_threshold_n", [0.1], "HSC force threshold [N]", 1.0),
        ("safety.window", [50], "window [ticks]", 1.0),
        ("safety.estimator.cutoff_hz", [30.0], "estimator cutoff [Hz]", 1.0),
        ("environment.objects.0.contact.stiffness", [200.0], "contact stiffness [N/m]", 1.0),
        ("environment.bodies.0.mass_kg", [0.2], "body mass [kg]", 1.0),
        ("coupling.tool_mass_kg", [0.2], "coupling tool mass [kg]", 1.0),  # its doc has no unit
        ("operator.legs.1.end.2", [0.0, np.nan], "leg end 2 [m]", 1.0),
        ("position_rmse_m", [0.002], "position error, RMS [mm]", 1e3),
        ("run.seed", [1.0], "seed", 1.0),
    ):
        assert label_of(path).sized(values) == (text, factor), path


def test_every_number_of_a_scene_has_a_label() -> None:
    found = list(numbers_of(inspect.type_info(Scene), ()))
    assert len(found) > 150
    for path in found:
        text, _ = label_of(path).sized([])
        assert not RAW.search(text), path
        if suffix := re.search(r"_(s|ms|m|n|j|kg|hz|w)$", path):
            assert text.endswith("]"), (path, suffix[1])


def numbers_of(kind: inspect.Type, path: tuple[str, ...], seen: tuple[type, ...] = ()) -> Iterator[str]:
    """Yield the paths of all fields of a table that are numbers."""
    for of in members(kind):
        if isinstance(of, inspect.FloatType | inspect.IntType):
            yield ".".join(path)
        elif isinstance(of, inspect.VarTupleType):
            yield from numbers_of(of.item_type, (*path, "0"), seen)
        elif isinstance(of, inspect.StructType) and of.cls not in seen:
            for field in of.fields:
                yield from numbers_of(field.type, (*path, field.name), (*seen, of.cls))


def test_a_constant_does_not_fill_an_axis_with_its_rounding() -> None:
    columns = sweep_of(a=TEN) | {"time_to_trip_s": 0.045 + 1e-17 * TEN, "position_rmse_m": 3.0 + 0.1 * TEN}
    panels = {panel.get_ylabel(): panel for panel in draw_sweep("s", columns, ["a"]).axes}
    for name, least in (("time_to_trip_s", 0.05 * 0.045), ("position_rmse_m", 0.15), ("false_trips", 1.0)):
        low, high = panels[name].get_ylim()
        assert high - low >= least, name
    assert panels["false_trips"].get_ylim()[1] >= 1.0


def test_lines_of_choices_that_coincide_show_below_each_other() -> None:
    kinds = np.repeat(["position-force", "pd-damped", "position-position"], 10)
    columns = {"coupling.kind": kinds, "a": np.tile(TEN, 3), "peak_device_force": np.ones(30)}
    figure = draw_sweep("s", columns, ["coupling.kind", "a"])
    check(figure)
    lines = [line for line in figure.axes[0].get_lines() if len(np.asarray(line.get_xdata())) == 10]
    widths = [line.get_linewidth() for line in lines if line.get_label() in set(kinds.tolist())]
    assert widths == sorted(widths, reverse=True)
    assert len(set(widths)) == 3
    assert not {to_hex(line.get_color()) for line in lines} & {colour for colour, _ in CONTROLLERS.values()}


def test_a_sweep_over_seeds_has_the_mean_and_its_confidence() -> None:
    varied = {"delay": TEN, "run.seed": np.arange(5.0)}
    columns = sweep_of(**varied)
    figure = draw_sweep("s", columns, list(varied))
    panel = figure.axes[0]
    line = next(line for line in panel.get_lines() if line.get_label() == "mean")
    of_last = columns["max_ejection_velocity"][columns["delay"] == TEN[-1]]
    assert np.asarray(line.get_ydata())[-1] == pytest.approx(of_last.mean())
    (band,) = panel.collections
    high = band.get_paths()[0].get_extents().y1
    half = 2.7764 * of_last.std(ddof=1) / np.sqrt(5)
    assert high >= of_last.mean() + 0.999 * half
    assert "not measured in some runs" in [line.get_label() for line in panel.get_lines()]


def test_more_than_two_axes_are_refused() -> None:
    varied = {"a": TEN[:2], "b": TEN[:2], "c": TEN[:2]}
    with pytest.raises(ValueError, match=r"a, b, c vary: a picture has at most 2 beside run\.seed"):
        draw_sweep("s", sweep_of(**varied), list(varied))
    nothing = {"a": TEN, "max_ejection_velocity": np.full(10, np.nan)}
    with pytest.raises(ValueError, match="no metric was measured"):
        draw_sweep("s", nothing, ["a"])


def test_the_confidence_is_students() -> None:
    for degrees, quantile in ((1, 12.7062), (2, 4.30265), (3, 3.18245), (4, 2.77645), (10, 2.22814), (1000, 1.96234)):
        assert student_quantile(degrees) == pytest.approx(quantile, rel=1e-3)
    assert mean_and_half(np.array([1.0, np.nan, 3.0])) == pytest.approx((2.0, 12.7062), rel=1e-4)
    with pytest.raises(ValueError, match="must be 1 or more"):
        student_quantile(0)


@pytest.mark.parametrize("columns", [1, 2])
@pytest.mark.parametrize(("packets", "lost", "every_s"), [(10_000, 0.1, 3.7), (10_000, 0.0, 0.01), (1, 0.0, None),
                                                         (1, 1.0, None), (50, 1.0, 0.02)])  # fmt: skip
def test_no_label_of_a_link_falls_off_or_overlaps(
    packets: int, lost: float, every_s: float | None, columns: Columns
) -> None:
    random = np.random.default_rng(3)
    sent = np.arange(packets, dtype=np.int64) * 1_000_000
    arrived = sent + (40e6 + 5e6 * random.normal(size=packets)).astype(np.int64)
    arrived[random.random(packets) < lost] = -1
    figure = draw_link("what is sent", sent, arrived, every_s, columns)
    check(figure)
    over_time = figure.axes[0]
    dots = [line for line in over_time.get_lines() if line.get_label() == "arrived"]
    assert len(np.asarray(dots[0].get_xdata())) == np.count_nonzero(arrived >= 0)
    looped = every_s is not None and sent[-1] * 1e-9 >= every_s
    assert ("begins anew" in figure.get_suptitle()) == looped


# --------------------------------------------------------------------------------------------------- the studies


@pytest.fixture(scope="module")
def paper(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[int, Figure]]:
    """Return each figure of the paper, in both widths, by the name of its file."""
    kept: dict[str, dict[int, Figure]] = {}
    report = paper_sensitivity(reproduce_paper(), changes=[{"release_s": 0.1}, {"estimator": "kalman"}])
    widths: tuple[Columns, ...] = (1, 2)
    for columns in widths:

        def keep(figure: Figure, path: Path, columns: Columns = columns) -> None:
            kept.setdefault(path.stem, {})[columns] = figure

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("haptether.studies.paper.figures.write_figure", keep)
            draw_paper(report, tmp_path_factory.mktemp("paper"), "pdf", columns)
    return kept


def test_no_label_of_the_paper_falls_off_or_overlaps(paper: dict[str, dict[int, Figure]]) -> None:
    assert len(paper) == 7
    for figures in paper.values():
        for figure in figures.values():
            check(figure)


def test_ours_is_beside_what_the_paper_says(paper: dict[str, dict[int, Figure]]) -> None:
    for name, figures in paper.items():
        drawn = [line for panel in figures[2].axes for line in panel.get_lines() if line.get_color() == PAPER]
        assert drawn, name
    (row,) = [line for line in paper["table1_window"][2].axes[0].get_lines() if line.get_label() == "paper"]
    assert np.asarray(row.get_ydata())[:3] == pytest.approx([0.438, 0.357, 0.348])


@pytest.fixture
def demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Figure:
    kept: dict[Path, Figure] = {}
    monkeypatch.setattr("haptether.studies.demo.write_figure", lambda figure, path: kept.update({path: figure}))
    results = []
    time_s = np.arange(4000) * 1e-3
    for controller in ("none", "vfc", "hsc", "wsc"):
        np.savez(tmp_path / f"{controller}.npz", time_s=time_s, velocity=np.sin(time_s), device_force=time_s,
                 position=time_s)  # fmt: skip
        results.append(PushResult(
            controller=controller, security="secure", engaged_s=0.1, release_s=2.6, peak_hand_speed=1.0,
            peak_force_n=1.0, time_to_trip_s=None, trips_before_release=0, intervention_s=0.0, sent=1, lost=0, late=0,
            refused=0, round_trip_s=0.1, overshoot_p50_s=0.0, overshoot_p99_s=0.0, ticks=1, skipped_ticks=0, holds=0,
            outliers=0, dropped_records=0, unsent=0, force_at_release_n=1.0, final_state="engaged", fault=None,
        ))  # fmt: skip
    for columns in (1, 2):
        draw_demo(DemoScene(), results, tmp_path, tmp_path / f"{columns}.png", columns)
        check(kept[tmp_path / f"{columns}.png"])
    return kept[tmp_path / "2.png"]


def test_a_controller_has_one_colour_in_all_figures(paper: dict[str, dict[int, Figure]], demo: Figure) -> None:
    titles = {"no controller": "none", "VFC": "vfc", "HSC": "hsc", "WSC": "wsc", "VFC, as printed": "vfc",
              "WSO, w = 100": "wsc", "HGO": "hsc"}  # fmt: skip
    seen: dict[str, set[str]] = {}
    for figure in (demo, *(of[2] for of in paper.values())):
        for panel in figure.axes:
            for line in panel.get_lines():
                if (label := str(line.get_label())) in titles:
                    seen.setdefault(titles[label], set()).add(to_hex(line.get_color()))
    assert seen == {name: {CONTROLLERS[name][0]} for name in ("none", "vfc", "hsc", "wsc")}
    tripped = draw_run(AWKWARD["many trips close together"]).axes[-1]
    assert {to_hex(np.asarray(bar.get_facecolor())[0].tolist()) for bar in tripped.collections} == {
        CONTROLLERS["wsc"][0]
    }


# --------------------------------------------------------------------------------------------------- the style


def luminance_and_tone(colour: str, *, blind: bool) -> npt.NDArray[np.float64]:
    """Return a colour as perceived, with or without red-green vision (Vienot, Brettel, Mollon 1999)."""
    rgb = np.array([int(colour[at : at + 2], 16) / 255.0 for at in (1, 3, 5)]) ** 2.2
    seen = (
        np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]]) @ rgb if blind else rgb
    )
    return np.clip(seen, 0.0, 1.0) ** (1.0 / 2.2)


@pytest.mark.parametrize("blind", [False, True])
def test_controllers_can_be_told_apart(blind: bool) -> None:
    colours = [*(colour for colour, _ in CONTROLLERS.values()), UNION, PAPER]
    for number, one in enumerate(colours):
        for other in colours[:number]:
            distance = np.linalg.norm(luminance_and_tone(one, blind=blind) - luminance_and_tone(other, blind=blind))
            assert distance > 0.12, (one, other)
    assert len({str(dashes) for _, dashes in CONTROLLERS.values()}) == 4


def test_unions_are_told_by_their_dashes() -> None:
    assert controller_look("wsc+hsc") == controller_look(["hsc", "wsc"])
    assert controller_look("hsc+wsc")["color"] == UNION
    assert controller_look("hsc+wsc")["linestyle"] != controller_look("vfc+wsc")["linestyle"]
    assert controller_look([]) == controller_look("none")
    assert controller_title("hsc+wsc") == "HSC + WSC"
    assert controller_title([]) == "no controller"
    # A controller in Python may have any name.
    assert controller_look("xyz") == controller_look("abc") != controller_look("wsc")
    assert controller_look("wsc+xyz") != controller_look("hsc+xyz")
    assert controller_title("wsc+xyz") == "WSC + xyz"


@pytest.mark.parametrize("columns", [1, 2])
def test_sizes_are_those_that_were_asked_for(tmp_path: Path, columns: Columns) -> None:
    run = AWKWARD["one tick"]
    figure = run.plot(tmp_path / "run.png", columns=columns)
    head = (tmp_path / "run.png").read_bytes()[16:24]
    assert int.from_bytes(head[:4], "big") == pytest.approx(WIDTHS_IN[columns] * 200, abs=1)
    assert int.from_bytes(head[4:], "big") == pytest.approx(figure.get_figheight() * 200, abs=1)
    run.plot(tmp_path / "run.pdf", columns=columns)
    media = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+) ?\]", (tmp_path / "run.pdf").read_bytes())
    assert media is not None
    assert float(media[1]) == pytest.approx(WIDTHS_IN[columns] * 72.0, abs=0.1)
    run.plot(tmp_path / "run.svg", columns=columns)
    width = re.search(r'<svg[^>]* width="([\d.]+)pt"', (tmp_path / "run.svg").read_text())
    assert width is not None
    assert float(width[1]) == pytest.approx(WIDTHS_IN[columns] * 72.0, abs=0.1)


@pytest.mark.parametrize(("style", "font"), [("screen", b"DejaVuSans"), ("paper", b"STIXGeneral")])
def test_fonts_are_embedded_whatever_the_user_has_set(tmp_path: Path, style: PictureStyle, font: bytes) -> None:
    import matplotlib as mpl

    with (
        picture_style(style),
        mpl.rc_context({"pdf.fonttype": 3, "svg.fonttype": "none", "font.size": 40.0, "savefig.dpi": 10.0}),
    ):
        for ending in ("pdf", "svg", "png"):
            AWKWARD["one tick"].plot(tmp_path / f"run.{ending}")
    text = (tmp_path / "run.pdf").read_bytes()
    for stream in re.findall(rb"stream\r?\n(.*?)endstream", text, re.DOTALL):
        try:
            text += zlib.decompress(stream)
        except zlib.error:
            continue
    assert b"/FontFile2" in text
    assert font in text
    assert b"/Subtype /Type3" not in text
    svg = (tmp_path / "run.svg").read_text()
    assert "<text" not in svg
    assert int.from_bytes((tmp_path / "run.png").read_bytes()[16:20], "big") > 1400


def test_the_same_figure_is_the_same_bytes(tmp_path: Path) -> None:
    for ending in ("pdf", "svg"):
        for number in range(2):
            AWKWARD["one tick"].plot(tmp_path / f"{number}.{ending}")
        assert (tmp_path / f"0.{ending}").read_bytes() == (tmp_path / f"1.{ending}").read_bytes()


def test_what_cannot_be_drawn_is_refused(tmp_path: Path) -> None:
    run = AWKWARD["one tick"]
    with pytest.raises(ValueError, match=r"run\.gif: must end in \.png, \.pdf, \.svg"):
        run.plot(tmp_path / "run.gif")
    with pytest.raises(ValueError, match="columns = 3: must be 1 or 2"):
        run.plot(columns=3)  # type: ignore[arg-type]
    bare = Run(scene="bare", seed=0, version="0", signals=Signals({}), events=(), metrics=Metrics())
    with pytest.raises(ValueError, match="bare: no signals to draw"):
        bare.plot()
    link = tmp_path / "link.png"
    link.symlink_to(tmp_path / "elsewhere.png")
    with pytest.raises(OSError, match="symbolic link"):
        run.plot(link)
    assert not (tmp_path / "elsewhere.png").exists()


def test_a_picture_is_its_owners_alone(tmp_path: Path) -> None:
    with styled():
        figure = new_figure(1, 1.0, "a title")
    write_figure(figure, tmp_path / "x.png")
    assert (tmp_path / "x.png").stat().st_mode & 0o777 == 0o600


def test_signals_have_the_colours_of_the_3d_view() -> None:
    from haptether.view.scene3d import colours

    assert SIGNALS["hand"] == colours.DEVICE_FORCE
    assert SIGNALS["commanded"] == colours.COMMANDED
