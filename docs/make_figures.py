"""Draw the pictures of the documentation: screenshots of what the demonstration writes (needs Chromium)."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

from imulab.demo import run

FIGURES = Path(__file__).resolve().parent / "figures"


def screenshot(page: Path, picture: Path, width: int, height: int) -> None:
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        raise SystemExit("make_figures: no Chromium here (Debian package chromium)")
    with tempfile.TemporaryDirectory() as profile:
        subprocess.run(
            [
                browser, "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
                "--hide-scrollbars", f"--user-data-dir={profile}", f"--window-size={width},{height}",
                "--virtual-time-budget=8000", f"--screenshot={picture}", page.as_uri(),
            ],
            check=True, capture_output=True,
        )  # fmt: skip


def main() -> None:
    FIGURES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        run(folder)
        screenshot(Path(folder).resolve() / "tumble.html", FIGURES / "tumble.png", 1080, 930)


if __name__ == "__main__":
    main()
