"""Laws of samples and populations of hands: moments, reproducibility, sweeps, refusals, and the page about them."""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from haptether.bridge import (
    FigureSource,
    Population,
    PopulationHand,
    PopulationTrait,
    SampleLaw,
    SceneError,
    load_population,
    load_scene,
    population_names,
    sweep,
    sweep_to_file,
)
from haptether.bridge.scene.sweeps.laws import generator, law_of, sobol_points
from haptether.bridge.scene.sweeps.population import HAND_MODELS
from haptether.cli import main

ROOT = Path(__file__).resolve().parents[2]
MANY = 20_000
ERRORS = 5.0
"""Permitted distance of a mean in standard errors: a right mean exceeds it once in two million draws."""


def moments(law: SampleLaw) -> tuple[float, float]:
    """Return mean and standard deviation of a law in closed form."""
    numbers = law.numbers
    if law.name in {"normal", "lognormal"}:
        return numbers[0], numbers[1]
    if law.name == "constant":
        return numbers[0], 0.0
    if law.name == "loguniform":
        least, most = numbers
        over = float(np.log(most / least))
        mean = (most - least) / over
        return mean, float(np.sqrt((most**2 - least**2) / (2.0 * over) - mean**2))
    if law.name == "uniform":
        numbers = (0.0, numbers[0], 1.0, numbers[1])
    # The law is a mixture of uniform laws, weighted by the shares of the parts.
    shares, values = np.array(numbers[::2]), np.array(numbers[1::2])
    share = np.diff(shares) / (shares[-1] - shares[0])
    low, high = values[:-1], values[1:]
    mean = float(share @ (low + high) / 2.0)
    return mean, float(np.sqrt(share @ (low**2 + low * high + high**2) / 3.0 - mean**2))


def assert_moments(drawn: np.ndarray, mean: float, deviation: float) -> None:
    """Assert both moments within their standard errors; the deviation's error comes from the drawn fourth moment."""
    count = len(drawn)
    assert abs(drawn.mean() - mean) <= ERRORS * deviation / np.sqrt(count) + 1e-12 * abs(mean)
    fourth = float(np.mean((drawn - mean) ** 4))
    error = np.sqrt(max(fourth - deviation**4, 0.0) / count) / max(2.0 * deviation, 1e-300)
    assert abs(drawn.std() - deviation) <= ERRORS * error + 1e-12 * abs(mean)


LAWS = [
    "uniform:2:4", "loguniform:200:600", "normal:9:1", "lognormal:9:3", "quantiles:0=1:1=2",
    "quantiles:0.025=228:0.5=379.5:0.975=651", "quantiles:0=0:0.1=0:0.9=3:1=30",
]  # fmt: skip


@pytest.mark.parametrize("text", LAWS)
def test_a_law_has_its_mean_and_its_deviation(text: str) -> None:
    law = law_of(text)
    drawn = law.draw(generator(1, "operator.stiffness"), MANY)
    assert_moments(drawn, *moments(law))
    low, high = law.support
    assert ((low <= drawn) & (drawn <= high)).all()
    # Draw the same law by inversion, at the middles of equal parts.
    assert_moments(law.quantile((np.arange(MANY) + 0.5) / MANY), *moments(law))


@pytest.mark.parametrize("text", LAWS)
def test_the_same_seed_draws_the_same_and_more_draws_begin_alike(text: str) -> None:
    law = law_of(text)
    drawn = law.draw(generator(3, "a"), 50)
    assert (law.draw(generator(3, "a"), 80)[:50] == drawn).all()
    assert (law.draw(generator(4, "a"), 50) != drawn).any()
    assert (law.draw(generator(3, "b"), 50) != drawn).any()


def test_measurements_are_drawn_by_their_quantiles(tmp_path: Path) -> None:
    measured = np.random.default_rng(1).gamma(4.0, 100.0, 41)
    path = tmp_path / "hands.csv"
    path.write_text("person,K\n" + "".join(f"p{place},{value!r}\n" for place, value in enumerate(measured.tolist())))
    law = law_of(f"measured:{path}:K")
    shares = np.linspace(0.0, 1.0, 1001)
    # NumPy's default has the same definition.
    np.testing.assert_allclose(law.quantile(shares), np.quantile(measured, shares), rtol=1e-12)
    assert law.support == (measured.min(), measured.max())


def test_a_population_of_measurements_names_them_relative_to_itself(tmp_path: Path) -> None:
    (tmp_path / "hands.csv").write_text("K\n100\n200\n400\n")
    path = tmp_path / "ours.toml"
    path.write_text(GOOD.replace("stiffness = 100.0", 'stiffness = "measured:hands.csv:K"'))
    assert load_population(path).hands[0].figures["stiffness"] == law_of("quantiles:0=100:0.5=200:1=400")
    (tmp_path / "hands.csv").write_text("K\n100\n-200\n400\n")
    with pytest.raises(SceneError, match=r"ours.toml: hands.0 \(one\).figures: stiffness = .*: must be above 0"):
        load_population(path)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("a\n1\n2\n", "its header has 1 columns and no 'K'"),
        ("K\n1\nnan\n", 'line 3: K = "nan": must be a finite number'),
        ("a,K\n1,2\n1\n", 'line 3: K = "": must be a finite number'),
        ("K\n1\n", "1 rows: must be 2 to"),
        ("", "its header has 0 columns"),
        (None, "cannot be read"),
    ],
)
def test_a_file_without_measurements_is_refused(text: str | None, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "hands.csv"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ValueError, match=re.escape(problem)):
        law_of(f"measured:{path}:K")


@pytest.mark.parametrize(
    "text",
    [
        "", "cauchy:1:2", "uniform:1", "uniform:1:2:3", "uniform:2:1", "uniform:a:b", "loguniform:0:1", "normal:1:0",
        "lognormal:0:1", "lognormal:1:0", "normal:nan:1", "uniform:0:inf", "quantiles:0=1", "quantiles:0=1:0=2",
        "quantiles:-0.1=1:1=2", "quantiles:0=1:1.1=2", "quantiles:0=2:1=1", "quantiles:0=1:1", "quantiles:0=1:1=nan",
        "measured:", "measured:a.csv", "uniform:",
    ],
)  # fmt: skip
def test_a_law_in_no_form_is_refused(text: str) -> None:
    form = "measured:FILE.csv:COLUMN" if text.startswith("measured") else "uniform:a:b with a < b"
    with pytest.raises(ValueError, match=re.escape(f'"{text}": must be {form}')):
        law_of(text)


POSITIVE = st.floats(min_value=1.0, max_value=1e4)


@settings(max_examples=50, deadline=None)
@given(grasp=POSITIVE, arm=POSITIVE, b1=st.floats(0.0, 50.0), b2=st.floats(0.0, 50.0), mass=st.floats(0.01, 2.0))
def test_a_grasp_and_an_arm_are_felt_in_series(grasp: float, arm: float, b1: float, b2: float, mass: float) -> None:
    """Stiffness and damping are those of the total impedance at a frequency far below its resonance."""
    figures = {"grasp_stiffness": grasp, "grasp_damping": b1, "arm_stiffness": arm, "arm_damping": b2}
    fields = HAND_MODELS["grasp-and-arm"].fields({name: np.array([value]) for name, value in figures.items()})
    # At s = j w, |terms of second order| / K is below (w / w_0)^2: 1e-8 at a ten-thousandth of the slowest pole.
    slowest = min(np.sqrt((grasp + arm) / mass), (grasp + arm) / max(b1 + b2, 1e-9), arm / max(b2, 1e-9),
                  grasp / max(b1, 1e-9), np.sqrt(arm / mass))  # fmt: skip
    s = 1e-4j * slowest
    moved = mass * s**2 + b2 * s + arm
    whole = (grasp + b1 * s) * moved / (grasp + b1 * s + moved)
    stiffness, damping = fields["operator.stiffness"][0], fields["operator.damping"][0]
    assert abs(whole.real / stiffness - 1.0) < 1e-6
    # The share of damping in |whole| is at most 1e-4 here, with an error of 1e-7 of |whole|.
    assert abs(whole.imag - damping * abs(s)) < 1e-9 * stiffness + 1e-6 * damping * abs(s)


@pytest.mark.parametrize("name", population_names())
def test_a_shipped_population_draws_its_published_figures(name: str) -> None:
    population = load_population(name)
    drawn = population.draws(MANY, 1)
    weights = np.array([hand.weight for hand in population.hands])
    for trait in population.traits:
        assert_moments(drawn[trait.field], *moments(trait.law))
    # Figures identify the hand of each row, even for hands with similar names.
    for hand in population.hands:
        alone = Population(title="one", hands=(hand,)).draws(MANY, 1)
        if hand.model == "spring-damper":
            assert_moments(alone["operator.stiffness"], *moments(hand.figures["stiffness"]))
            assert_moments(alone["operator.damping"], *moments(hand.figures["damping"]))
        shared = np.isin(drawn["operator.stiffness"], alone["operator.stiffness"])
        # A hand's rows are those of the hand alone, with the same pairs of stiffness and damping.
        assert (drawn["operator.damping"][shared] == alone["operator.damping"][shared]).all()
        part = hand.weight / weights.sum()
        assert abs(shared.mean() - part) < ERRORS * np.sqrt(part * (1.0 - part) / MANY)


def test_the_figures_that_all_models_share_are_consistent() -> None:
    """Slow motion feels the grasp and the arm in series: less than the grasp alone."""
    slow, fast = load_population("stylus-arm"), load_population("stylus-grasp")
    for below, above in zip(slow.hands, fast.hands, strict=True):
        assert below.name == above.name
        assert below.figures["grasp_stiffness"] == above.figures["stiffness"]
        assert below.figures["grasp_damping"] == above.figures["damping"]
    assert (slow.draws(200)["operator.stiffness"] < fast.draws(200)["operator.stiffness"]).all()


@pytest.mark.parametrize("name", population_names())
def test_the_same_seed_draws_the_same_hands(name: str) -> None:
    population = load_population(name)
    drawn = population.draws(60, 5)
    again, more, other = population.draws(60, 5), population.draws(90, 5), population.draws(60, 6)
    for path, column in drawn.items():
        assert (again[path] == column).all()
        assert (more[path][:60] == column).all()
    assert any((other[path] != column).any() for path, column in drawn.items())
    without = Population(title="t", hands=population.hands).draws(60, 5)
    assert all((without[path] == drawn[path]).all() for path in without)
    points = sobol_points(population.dimensions, 64, 1)
    assert all(np.isfinite(column).all() for column in population.draws(64, 1, points=points).values())


def test_traits_of_parts_that_a_scene_lacks_are_left_out() -> None:
    population = load_population("handle")
    fields = {trait.field for trait in population.traits}
    assert fields == {"operator.tremor.amplitude", "operator.tremor.frequency_hz", "operator.regrasp.reaction_s"}
    with_tremor = population.draws(2, scene=load_scene("free_motion"))
    assert with_tremor.keys() & fields == {"operator.tremor.amplitude", "operator.tremor.frequency_hz"}
    assert not population.draws(2, scene=load_scene("remote_push")).keys() & fields
    with pytest.raises(SceneError, match=r"the scene has no \[operator\]"):
        population.draws(2, scene=replace(load_scene("remote_push"), operator=None))


SHORT = ("run.duration_s=0.3",)


def test_a_sweep_over_a_population_is_the_same_whatever_the_threads(tmp_path: Path) -> None:
    seeds = {"run.seed": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]}
    drawn = load_population("stylus-grasp").draws(7, 9, scene=load_scene("remote_push"))
    rows = list(sweep("remote_push", samples={**drawn, **seeds}, overrides=SHORT, threads=1).rows())
    for threads, lanes in ((1, True), (2, True), (2, False)):
        found = sweep(
            "remote_push",
            samples=seeds,
            population="stylus-grasp",
            seed=9,
            overrides=SHORT,
            threads=threads,
            lanes=lanes,
        )
        assert list(found.rows()) == rows
    stored = sweep_to_file(
        "remote_push", tmp_path / "rows.csv", {"safety.window": [50.0, 100.0]}, seeds,
        population="stylus-grasp", seed=9, overrides=SHORT, collect=True,
    )  # fmt: skip
    assert stored.whole is not None
    # Each combination has the same hands.
    np.testing.assert_array_equal(stored.whole["operator.stiffness"], np.tile(drawn["operator.stiffness"], 2))
    command = ["sweep", "remote_push", "--samples", "7", "--population", "stylus-grasp", "--seed", "9", "--set", *SHORT]
    assert main([*command, "--out", str(tmp_path / "command.csv")]) == 0
    sweep("remote_push", samples={**drawn, **seeds}, overrides=SHORT).save(tmp_path / "python.csv")
    assert (tmp_path / "command.csv").read_bytes() == (tmp_path / "python.csv").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["--population", "handle", "--vary", "safety.window=50"], "--population: give --samples"),
        (["--population", "stylus", "--samples", "2"], "stylus: no such population: did you mean stylus-"),
        (
            ["--population", "handle", "--samples", "2", "--draw", "operator.damping=uniform:1:2"],
            "operator.damping: is",
        ),
        (["--population", "handle", "--samples", "2", "--vary", "operator.stiffness=1,2"], "operator.stiffness: is"),
        (["--population", "no.toml", "--samples", "2"], "no.toml: cannot be read"),
    ],
)
def test_a_population_that_cannot_be_is_refused_on_the_command_line(
    arguments: list[str], problem: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["sweep", "remote_push", *arguments]) == 2
    assert problem in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("more", "problem"),
    [
        ({"population": "handle"}, "population: give samples"),
        ({"population": "handle", "samples": {"run.seed": [1.0]}, "seed": -1}, "seed = -1: must be 0 or more"),
        ({"population": "handle", "samples": {"run.seed": [1.0]}, "seed": 1.0}, "seed = 1.0: must be a whole number"),
        ({"population": "handle", "samples": {"run.seed": [1.0]}, "seed": 1.5}, "seed = 1.5: must be a whole number"),
        ({"population": "handle", "samples": {"run.seed": 3}}, "run.seed = 3: must be a list of values"),
        ({"population": "", "samples": {"run.seed": [1.0]}}, '"": no such population: there is handle, '),
        (
            {"population": str(Path(__file__).parent), "samples": {"run.seed": [1.0]}},
            "scene: is a folder, must be the name of a shipped population or a TOML file",
        ),
        ({"population": __file__, "samples": {"run.seed": [1.0]}}, "test_population.py: must end in .toml, or be the"),
        ({"population": 5, "samples": {"run.seed": [1.0]}}, "population = 5: must be the name of a shipped population"),
        ({"population": "handle", "samples": {"operator.damping": [1.0]}}, "operator.damping: is drawn from"),
    ],
)
def test_a_sweep_that_does_not_fit_a_population_is_refused(more: Mapping[str, object], problem: str) -> None:
    with pytest.raises(ValueError, match=re.escape(problem)):
        sweep("remote_push", **more)  # type: ignore[arg-type]


GOOD = """title = "T"
[[hands]]
name = "one"
model = "spring-damper"
subjects = 3
measured = "m"
source = "s"
read_at = "a"
verified = true
[hands.figures]
stiffness = 100.0
damping = "uniform:1:2"
[[traits]]
field = "operator.tremor.amplitude"
law = 1e-4
measured = "m"
source = "s"
read_at = "a"
verified = false
"""


def test_a_folder_of_its_name_does_not_hide_a_shipped_population(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = population_names()[0]
    expected = load_population(name)
    (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path)
    assert load_population(name) == expected


def test_a_file_of_ones_own_is_read(tmp_path: Path) -> None:
    path = tmp_path / "ours.toml"
    path.write_text(GOOD)
    of = {"source": "s", "measured": "m", "read_at": "a"}
    assert load_population(path) == Population(
        title="T",
        hands=(
            PopulationHand(
                name="one", model="spring-damper", weight=1.0,
                figures={"stiffness": SampleLaw("constant", (100.0,)), "damping": SampleLaw("uniform", (1.0, 2.0))},
                published=FigureSource(subjects=3, verified=True, **of),
            ),
        ),
        traits=(
            PopulationTrait(
                field="operator.tremor.amplitude", law=SampleLaw("constant", (1e-4,)),
                published=FigureSource(subjects=None, verified=False, **of),
            ),
        ),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("stiffness = 100.0", "stiffness = nan", "hands.0 (one).figures: stiffness = nan: must be a finite number"),
        ("stiffness = 100.0", "stiffness = inf", "hands.0 (one).figures: stiffness = inf: must be a finite number"),
        ("stiffness = 100.0", "stiffness = -1", "hands.0 (one).figures: stiffness = -1: must be above 0 throughout"),
        ("stiffness = 100.0", "stiffness = 0", "hands.0 (one).figures: stiffness = 0: must be above 0 throughout"),
        ("stiffness = 100.0", "stiffness = true", "hands.0 (one).figures: stiffness = true: must be a finite number"),
        ("stiffness = 100.0", "", "hands.0 (one).figures: stiffness is missing"),
        ("stiffness = 100.0", "stifness = 1\nstiffness = 100.0", "(one).figures: no key stifness: did you mean"),
        ('"uniform:1:2"', '"uniform:-1:2"', "figures: damping = \"uniform:-1:2\": must be 0 or more throughout"),
        ('"uniform:1:2"', '"normal:5:1"', "figures: damping = \"normal:5:1\": must be 0 or more throughout"),
        ('"uniform:1:2"', '"uniform:2:1"', "hands.0 (one).figures: damping: \"uniform:2:1\": must be uniform:a:b"),
        ('"spring-damper"', '"spring"', 'hands.0 (one): model = "spring": must be one of spring-damper'),
        ("subjects = 3", "subjects = 0", "hands.0 (one): subjects = 0: must be a whole number of 1 or more"),
        ("subjects = 3", "weight = 0", "hands.0 (one): weight = 0: must be a finite number above 0"),
        ("subjects = 3", "weigth = 1", "hands.0: no key weigth: did you mean weight?"),
        ("verified = true", "verified = 1", "hands.0 (one): verified = 1: must be true or false"),
        ('source = "s"\nread_at = "a"\nverified = true', "verified = true", "hands.0 (one): source is missing"),
        ('title = "T"', "", "population: title is missing"),
        ('title = "T"', 'title = "T"\nhand = 1', "population: no key hand: did you mean hands?"),
        ("[[hands]]", "[hand]", "population: no key hand"),
        ("law = 1e-4", "law = -1e-4", "(operator.tremor.amplitude): law: [operator.tremor] amplitude = -0.0001"),
        ("law = 1e-4", 'law = "normal:1:1"', "(operator.tremor.amplitude): law = \"normal:1:1\": must be a law"),
        ("law = 1e-4", "", "traits.0 (operator.tremor.amplitude): law is missing"),
        ("tremor.amplitude", "tremor.ampl", "traits.0 (operator.tremor.ampl): "),
        ("operator.tremor.amplitude", "safety.damping", 'field = "safety.damping": must be a number of [operator]'),
        ("operator.tremor.amplitude", "operator.stiffness", 'field = "operator.stiffness": must be a number of'),
        ("[[traits]]", "[[traits", "ours.toml: "),
    ],
)  # fmt: skip
def test_a_file_that_is_no_population_is_refused_with_its_place(
    old: str, new: str, problem: str, tmp_path: Path
) -> None:
    assert old in GOOD
    path = tmp_path / "ours.toml"
    path.write_text(GOOD.replace(old, new, 1))
    with pytest.raises(SceneError, match=re.escape(problem)) as refused:
        load_population(path)
    assert str(refused.value).startswith("ours.toml: ")
    assert "\n" not in str(refused.value)


def test_two_hands_of_one_name_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "ours.toml"
    hand = GOOD[GOOD.index("[[hands]]") : GOOD.index("[[traits]]")]
    path.write_text(GOOD.replace(hand, hand * 2))
    with pytest.raises(SceneError, match="hands: one is there twice"):
        load_population(path)


def law_cell(law: SampleLaw) -> str:
    """Return a law in the page's format."""
    if law.name == "constant":
        return f"{law.numbers[0]:g}"
    if law.name == "quantiles":
        points = zip(law.numbers[::2], law.numbers[1::2], strict=True)
        return ", ".join(f"{value:g} ({100.0 * share:g} %)" for share, value in points)
    return f"{law.name} {law.numbers[0]:g} to {law.numbers[1]:g}"


def published_table() -> str:
    """Return the page's section on each population, made from its file."""
    lines: list[str] = []
    sources: dict[str, dict[str, None]] = {}
    for name in population_names():
        population = load_population(name)
        lines += [f"### `{name}`", "", f"{population.title}.", ""]
        lines += ["| hand | figure | value | people | read in |", "|---|---|---|---|---|"]
        cells = [
            (hand.name, figure, law, hand.published)
            for hand in population.hands
            for figure, law in hand.figures.items()
        ]
        cells += [("all", f"`{trait.field}`", trait.law, trait.published) for trait in population.traits]
        for who, figure, law, of in cells:
            read = "the publication" if of.verified else "a transcription"
            lines.append(f"| {who} | {figure} | {law_cell(law)} | {of.subjects or '-'} | {read} |")
            citation = f"{of.source}. {of.measured}. Read at {of.read_at}."
            sources.setdefault(citation, {})[figure if who == "all" else f"`{name}` {who}"] = None
        lines.append("")
    lines += ["### Sources", "", *(f"- {', '.join(names)}: {citation}" for citation, names in sources.items())]
    return "\n".join(lines)


def test_the_page_has_the_figures_of_the_files() -> None:
    page = (ROOT / "docs" / "populations.md").read_text(encoding="utf-8")
    written = page[page.index("### `") : page.index("## A population of one's own")]
    # The page breaks its lines; the table has each row in one line.
    assert " ".join(written.split()) == " ".join(published_table().split())


def test_the_population_of_the_page_can_be_drawn(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "populations.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    (tmp_path / "ours.toml").write_text(text)
    drawn = load_population(tmp_path / "ours.toml").draws(MANY)
    assert_moments(drawn["operator.stiffness"], *moments(law_of("quantiles:0=90:0.25=140:0.5=210:0.75=260:1=420")))
    assert_moments(drawn["operator.damping"], 9.0, 3.0)


def test_traits_reach_into_lists_and_may_be_lognormal(tmp_path: Path) -> None:
    path = tmp_path / "ours.toml"
    path.write_text(
        GOOD.replace("operator.tremor.amplitude", "operator.legs.0.duration_s").replace(
            "law = 1e-4", 'law = "lognormal:1:0.2"'
        )
    )
    population = load_population(path)
    with_legs, without = load_scene("remote_push"), load_scene("remote_push", ["operator.legs=[]"])
    drawn = population.draws(200, scene=with_legs)["operator.legs.0.duration_s"]
    assert (drawn > 0.0).all()
    assert len(set(drawn.tolist())) == 200
    assert "operator.legs.0.duration_s" not in population.draws(2, scene=without)
