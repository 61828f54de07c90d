#!/usr/bin/env python3
"""Code size per object, worst stack per public function, and no double anywhere: footprint.py FOLDER of `make size`.

gcc -fcallgraph-info=su writes a graph of calls with the stack of each function; the worst path is the longest sum. The
core has no recursion. What libm needs (expf, log1pf) is not in the graph and is named apart.
"""

import re
import sys
from functools import cache
from pathlib import Path

# Helpers of the ABI that compute in double, and the double functions of libm.
DOUBLE = re.compile(r"__aeabi_(d\w+|f2d|i2d|ui2d|l2d|ul2d|cd\w+)$|^(sqrt|exp|log1p|fabs|pow|log|floor)$")


def call_graph(folder):
    stack, calls = {}, {}
    for file in sorted(folder.glob("*.ci")):
        text = file.read_text(encoding="utf-8")
        for title, label in re.findall(r'node: \{ title: "([^"]+)" label: "([^"]*)"', text):
            found = re.search(r"(\d+) bytes \((\w+)", label)
            if found:
                assert found.group(2) == "static", f"{title}: stack is not bounded"
                stack[title] = int(found.group(1))
        for source, target in re.findall(r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"', text):
            calls.setdefault(source, set()).add(target)
    return stack, calls


def main():
    folder = Path(sys.argv[1])
    stack, calls = call_graph(folder)

    @cache
    def worst(name):
        return stack.get(name, 0) + max((worst(callee) for callee in calls.get(name, ())), default=0)

    @cache
    def outside(name):
        found = {name} if name not in stack else set()
        return frozenset(found.union(*(outside(callee) for callee in calls.get(name, ()))))

    print((folder / "size.txt").read_text(encoding="utf-8").rstrip())
    print("\nworst stack, bytes (and functions outside the core on the way)")
    for name in sorted(n for n in stack if n.startswith("il_")):
        print(f"  {name:22} {worst(name):6}  {' '.join(sorted(outside(name)))}".rstrip())
    undefined = {line.split()[-1] for line in (folder / "symbols.txt").read_text().splitlines() if " U " in f" {line} "}
    own = {
        line.split()[-1] for line in (folder / "symbols.txt").read_text().splitlines() if re.search(r" [TtRr] ", line)
    }
    needed = sorted(undefined - own)
    double = [name for name in needed if DOUBLE.search(name)]
    print(f"\nsymbols from outside: {' '.join(needed)}")
    print(f"double precision: {' '.join(double) or 'none'}")
    return int(bool(double))


if __name__ == "__main__":
    sys.exit(main())
