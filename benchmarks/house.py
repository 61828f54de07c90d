"""Starting."""

from __future__ import annotations

from timing import Row, process, seconds


def rows() -> list[Row]:
    bare, loaded, shown = seconds(process("-c", ""), process("-c", "import imulab"), process("-m", "imulab", "--help"))
    return [
        ("`import imulab`, beyond a bare Python", f"{loaded - bare:.3f} s", "< 0.25 s"),
        ("`imulab --help`, whole process", f"{shown:.2f} s", "< 0.5 s"),
    ]
