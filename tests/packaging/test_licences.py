"""Licences of all linked and imported components permit shipping.

Two lists are checked against allow-lists of licences. The first has the crates of the whole Cargo graph, for every
platform. The second has the Python distributions that Haptether needs at run time, as installed from
tools/requirements.txt. Development and test dependencies are not shipped and not checked.

Known vulnerabilities of crates are out of scope: the advisory database is not available offline.
"""

import importlib.metadata
import json
import re
import subprocess
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]

PERMISSIVE = frozenset(
    {
        "0BSD",
        "Apache-2.0",
        "Apache-2.0 WITH LLVM-exception",
        "BSD-2-Clause",
        "BSD-3-Clause",
        "BSL-1.0",
        "CC0-1.0",
        "ISC",
        "MIT",
        "Unicode-3.0",
        "Unlicense",
        "Zlib",
    }
)

# A Python distribution stays a separate file that a user may replace: the LGPL requires no more.
PYTHON_ALLOWED = PERMISSIVE | {
    "HPND",
    "LGPL-2.1-or-later",
    "LGPL-3.0-only",
    "LGPL-3.0-or-later",
    "MIT-CMU",
    "PSF-2.0",
}

# Exceptions for single distributions. certifi is Mozilla's list of certificates as a file. The MPL permits its
# distribution beside works of other licences as long as that file stays under it.
OF_ONE = {"certifi": frozenset({"MPL-2.0"})}

# Distributions that predate licence expressions use a classifier.
CLASSIFIERS = {
    "Apache Software License": "Apache-2.0",
    "BSD License": "BSD-3-Clause",
    "GNU Lesser General Public License v2 or later (LGPLv2+)": "LGPL-2.1-or-later",
    "GNU Lesser General Public License v3 (LGPLv3)": "LGPL-3.0-only",
    "GNU Lesser General Public License v3 or later (LGPLv3+)": "LGPL-3.0-or-later",
    "ISC License (ISCL)": "ISC",
    "MIT License": "MIT",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0",
    "The Unlicense (Unlicense)": "Unlicense",
}

EXTRAS = ("", "analysis", "console", "dynamixel", "haply", "parquet", "record", "ur", "view")
"""The optional dependencies in tools/requirements.txt, and the package without any."""


class Expression:
    """An SPDX licence expression, read from left to right.

    `OR` binds weakest, then `AND`, then `WITH`. The slash of old crates means `OR`.
    """

    def __init__(self, text: str) -> None:
        self._text = text
        self._tokens: list[str] = re.findall(r"[()/]|[^\s()/]+", text)

    def satisfiable(self, allowed: frozenset[str]) -> bool:
        """Return true if a choice of `allowed` licences satisfies the expression."""
        result = self._either(allowed)
        if self._tokens:
            raise self._error()
        return result

    def _either(self, allowed: frozenset[str]) -> bool:
        result = self._both(allowed)
        while self._take("OR") or self._take("/"):
            result = self._both(allowed) or result
        return result

    def _both(self, allowed: frozenset[str]) -> bool:
        result = self._one(allowed)
        while self._take("AND"):
            result = self._one(allowed) and result
        return result

    def _one(self, allowed: frozenset[str]) -> bool:
        if self._take("("):
            result = self._either(allowed)
            if not self._take(")"):
                raise self._error()
            return result
        name = self._name()
        if self._take("WITH"):
            name = f"{name} WITH {self._name()}"
        return name in allowed

    def _name(self) -> str:
        if not self._tokens or self._tokens[0] in {"(", ")", "/", "AND", "OR", "WITH"}:
            raise self._error()
        return self._tokens.pop(0)

    def _take(self, token: str) -> bool:
        if self._tokens[:1] != [token]:
            return False
        self._tokens.pop(0)
        return True

    def _error(self) -> ValueError:
        return ValueError(f"not a licence expression: {self._text!r}")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("MIT", True),
        ("GPL-3.0-only", False),
        ("MIT OR GPL-3.0-only", True),
        ("GPL-3.0-only/MIT", True),
        ("MIT AND GPL-3.0-only", False),
        ("(MIT OR GPL-3.0-only) AND Unicode-3.0", True),
        # AND binds tighter: the first alternative suffices, the second does not.
        ("MIT OR ISC AND GPL-3.0-only", True),
        ("(MIT OR ISC) AND GPL-3.0-only", False),
        ("GPL-3.0-only OR MIT AND (ISC OR GPL-2.0-only)", True),
        ("Apache-2.0 WITH LLVM-exception", True),
        ("Apache-2.0 WITH Classpath-exception-2.0", False),
        ("GPL-2.0-only WITH LLVM-exception OR MIT", True),
    ],
)
def test_an_expression_is_met_by_a_permitted_choice(text: str, expected: bool) -> None:
    assert Expression(text).satisfiable(PERMISSIVE) is expected


@pytest.mark.parametrize("text", ["", "MIT OR", "(MIT", "MIT)", "MIT ISC", "AND MIT", "MIT WITH"])
def test_what_is_not_an_expression_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="not a licence expression"):
        Expression(text).satisfiable(PERMISSIVE)


def cargo_metadata() -> dict[str, list[dict[str, str | None]]]:
    """Return the Cargo graph, without the network if the crates are available."""
    command = ["cargo", "metadata", "--format-version", "1", "--locked"]
    answer = subprocess.run([*command, "--offline"], cwd=ROOT, capture_output=True, text=True, check=False)
    if answer.returncode != 0:
        answer = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stderr
    graph: dict[str, list[dict[str, str | None]]] = json.loads(answer.stdout)
    return graph


def test_every_crate_has_a_permissive_licence() -> None:
    crates = cargo_metadata()["packages"]
    refused = {
        f"{crate['name']} {crate['version']}: {crate['license']}"
        for crate in crates
        if crate["license"] is None or not Expression(crate["license"]).satisfiable(PERMISSIVE)
    }
    assert len(crates) > 6
    assert not refused


def runtime_distributions() -> dict[str, importlib.metadata.Distribution]:
    """Return the distributions that `haptether` with its locked extras needs, recursively, by name."""
    found: dict[str, importlib.metadata.Distribution] = {}
    pending: list[tuple[str, tuple[str, ...]]] = [("haptether", EXTRAS)]
    seen: set[tuple[str, tuple[str, ...]]] = set()
    while pending:
        name, extras = pending.pop()
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        found[name] = importlib.metadata.distribution(name)
        for text in found[name].requires or []:
            need = Requirement(text)
            if need.marker is None or any(need.marker.evaluate({"extra": e}) for e in extras):
                pending.append((canonicalize_name(need.name), ("", *sorted(need.extras))))
    return found


def licence(distribution: importlib.metadata.Distribution) -> str:
    """Return the licence expression of a distribution, from the best source that states one."""
    metadata = distribution.metadata
    if "License-Expression" in metadata:
        return metadata["License-Expression"]
    stated = [
        line.rpartition(" :: ")[2]
        for line in metadata.get_all("Classifier") or []
        # "OSI Approved" alone is not a licence.
        if line.startswith("License :: ") and line.count(" :: ") > 1
    ]
    if stated:
        return " AND ".join(CLASSIFIERS.get(name, name.replace(" ", "-")) for name in stated)
    if "License" in metadata:
        return CLASSIFIERS.get(metadata["License"], metadata["License"])
    return "none-stated"


def test_every_python_distribution_of_the_runtime_may_be_shipped_with() -> None:
    distributions = runtime_distributions()
    refused = {
        f"{name}: {licence(distribution)}"
        for name, distribution in distributions.items()
        if not Expression(licence(distribution)).satisfiable(PYTHON_ALLOWED | OF_ONE.get(name, frozenset()))
    }
    assert {"haptether", "numpy", "matplotlib"} <= distributions.keys()
    assert not refused
