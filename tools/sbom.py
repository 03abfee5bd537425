"""Prints the crates that the extension links, as a CycloneDX bill of materials without paths.

`make lock` writes it to `python/haptether.cdx.json`, which the wheel carries in `.dist-info/sboms/` (PEP 770). The bill
that maturin writes names the folder of the build.
"""

import json
import subprocess
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
EXTENSION = "haptether-python"


def bill() -> dict[str, Any]:
    """The bill of materials, from `cargo metadata`: normal dependencies on every platform."""
    command = ["cargo", "metadata", "--locked", "--offline", "--format-version", "1"]
    metadata = json.loads(subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout)
    packages = {package["id"]: package for package in metadata["packages"]}
    linked = {
        node["id"]: sorted(of["pkg"] for of in node["deps"] if any(kind["kind"] is None for kind in of["dep_kinds"]))
        for node in metadata["resolve"]["nodes"]
    }
    (root,) = [each for each, package in packages.items() if package["name"] == EXTENSION]
    found, waiting = {root}, [root]
    while waiting:
        for dependency in linked[waiting.pop()]:
            if dependency not in found:
                found.add(dependency)
                waiting.append(dependency)

    def reference(each: str) -> str:
        return f"pkg:cargo/{packages[each]['name']}@{packages[each]['version']}"

    def component(each: str) -> dict[str, Any]:
        package, purl = packages[each], reference(each)
        licence = (package["license"] or "").replace("/", " OR ")
        return {
            "type": "library",
            "bom-ref": purl,
            "name": package["name"],
            "version": package["version"],
            "licenses": [{"expression": licence}],
            "purl": purl,
        }

    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": component(root)},
        "components": [component(each) for each in sorted(found - {root}, key=reference)],
    }


def main() -> None:
    """Print the bill, one component a line."""
    found = bill()
    components = ",\n".join(map(json.dumps, found.pop("components")))
    print(f'{json.dumps(found)[:-1]}, "components": [\n{components}\n]}}')


if __name__ == "__main__":
    main()
