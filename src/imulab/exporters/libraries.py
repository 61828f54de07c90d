"""An exported folder as a library of Arduino, PlatformIO and Zephyr: manifests, and sources that take in the core.

Sources: Arduino library specification (library.properties, src, examples); PlatformIO library.json; Zephyr modules
(zephyr/module.yml, build.cmake and build.kconfig).
"""

from __future__ import annotations

import json
from importlib.resources import files

from imulab._version import VERSION

NAME = "imulab_unit"


def firmware_file(name: str) -> str:
    """Return a file that exported folders are made from."""
    return (files("imulab.exporters") / "firmware" / name).read_text(encoding="utf-8")


def libraries(unit: str) -> dict[str, str]:
    """Return names and contents of what makes the folder of a unit a library; the same for every unit but its name."""
    sentence = f"Compensation of {unit}."
    properties = {
        "name": NAME,
        "version": VERSION,
        "author": "imulab",
        "maintainer": "imulab",
        "sentence": sentence,
        "paragraph": "Turns raw outputs of inertial sensors into corrected ones.",
        "category": "Sensors",
        "architectures": "*",
        "includes": f"{NAME}.h",
    }
    manifest = {
        "name": NAME,
        "version": VERSION,
        "description": sentence,
        "frameworks": "*",
        "platforms": "*",
        "headers": f"{NAME}.h",
        "build": {"srcDir": "src", "includeDir": "src", "flags": ["-DIMULAB_UNIT_LIBRARY"]},
    }
    sources = (f"{NAME}.h", "imulab_core.c", "imulab_numbers.c")
    return {
        "library.properties": "".join(f"{key}={value}\n" for key, value in properties.items()),
        "library.json": json.dumps(manifest, indent=2, ensure_ascii=False) + "\n",
        **{f"src/{name}": firmware_file(name) for name in sources},
        **{f"zephyr/{name}": firmware_file(name) for name in ("module.yml", "Kconfig", "CMakeLists.txt")},
    }
