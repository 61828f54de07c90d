#!/usr/bin/env python3
"""Sum up what gcov -b printed: coverage.py LEAST REPORT SOURCE... exits 1 below LEAST per cent of lines or branches."""

import re
import sys
from pathlib import Path


def main():
    least, report, *sources = sys.argv[1:]
    text = Path(report).read_text(encoding="utf-8")
    totals = {"lines": [0.0, 0], "branches": [0.0, 0]}
    for source in sources:
        (part,) = [p for p in text.split("\n\n") if re.match(rf"File '[^']*\b{re.escape(source)}'", p)]
        shares = []
        for kind, pattern in (
            ("lines", r"Lines executed:([\d.]+)% of (\d+)"),
            ("branches", r"Taken .*:([\d.]+)% of (\d+)"),
        ):
            share, count = re.search(pattern, part).groups()
            totals[kind][0] += float(share) / 100 * int(count)
            totals[kind][1] += int(count)
            shares.append(f"{float(share):6.2f} % of {count:>4} {kind}")
        print(f"{source:14} {'   '.join(shares)}")
    reached = {kind: 100 * hit / count for kind, (hit, count) in totals.items()}
    print(f"{'all':14} {reached['lines']:6.2f} % of {totals['lines'][1]:>4} lines   ", end="")
    print(f"{reached['branches']:6.2f} % of {totals['branches'][1]:>4} branches")
    return int(min(reached.values()) < float(least))


if __name__ == "__main__":
    sys.exit(main())
