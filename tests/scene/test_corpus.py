"""Scene files that are wrong in every way: the only exception is `SceneError`, in one line with problem and place.

`fuzz/corpus/toml/` is replayed; hypothesis mutates those files and the shipped ones. `make fuzz` does so at length.
"""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from haptether.bridge import SceneError, load_scene, scene_names
from haptether.bridge.scene.load import scene_path

ROOT = Path(__file__).resolve().parents[2]
CORPUS = ROOT / "fuzz" / "corpus" / "toml"
FILES = sorted(CORPUS.iterdir())
GOOD = [scene_path(name) for name in scene_names(attacks=True)]
WORDS = [
    b"nan", b"-inf", b"1e999", b"-0.0", b"5e-324", b"9223372036854775807", b"99999999999999999999", b"0x7F",
    b"1979-05-27", b"true", b'""', b"''", b"[]", b"{}", b"[[]]", b"[run]\n", b"[[run]]\n", b"=", b".", b"#", b"\n",
    b"\r", b"\x00", b"\xff", b"\xef\xbb\xbf", b'"\\u0000"', b'"""', b"[master]\n", b"a.b.c = 1\n", b"[" * 200,
    b"kind = ", b"schema = 1\n",
]  # fmt: skip


def check(path: Path) -> None:
    """Load a file; assert that a refusal is one line that names the file."""
    try:
        load_scene(path)
    except SceneError as error:
        said = str(error)
        assert said.startswith(path.name), said
        assert len(said.splitlines()) == 1, said
        assert len(said) < 1000, said


def test_the_corpus_is_there() -> None:
    assert len(FILES) >= 20


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_file_of_the_corpus_is_read_or_refused(path: Path) -> None:
    check(path)


@st.composite
def mutated(draw: st.DrawFn) -> bytes:
    """Draw a scene file with bytes replaced, removed, doubled or exchanged for sequences that confuse parsers."""
    contents = draw(st.sampled_from(GOOD + FILES)).read_bytes()
    for _ in range(draw(st.integers(1, 6))):
        start = draw(st.integers(0, len(contents)))
        end = min(start + draw(st.integers(0, 20)), len(contents))
        piece = draw(st.one_of(st.sampled_from(WORDS), st.binary(max_size=4), st.just(contents[start:end] * 2)))
        contents = contents[:start] + piece + contents[end:]
    return contents


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("scenes")
    # The recordings of the shipped scenes lie beside them.
    for recording in (ROOT / "bridge" / "scenes").glob("*.csv"):
        (place / recording.name).write_bytes(recording.read_bytes())
    return place


@settings(suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture])
@given(contents=mutated())
def test_a_mutated_scene_is_read_or_refused(contents: bytes, folder: Path) -> None:
    path = folder / "mutated.toml"
    path.write_bytes(contents)
    check(path)
