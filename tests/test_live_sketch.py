"""The Arduino sketch of docs/streams.md: compiled with a stub of what it includes, its output read without a layout."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from imulab.live.formats import LineStream

PAGE = Path(__file__).resolve().parents[1] / "docs" / "streams.md"
STUB = r"""
#include <cstdint>
#include <cstdio>
static unsigned long now_us = 0;
static unsigned long micros() { return now_us; }
static void delay(unsigned ms) { now_us += 1000UL * ms; }
struct Port {
  void begin(long) {}
  void print(char c) { std::putchar(c); }
  void print(unsigned long v) { std::printf("%lu", v); }
  void print(double v, int places) { std::printf("%.*f", places, v); }
  void println() { std::printf("\r\n"); }
  void println(const char *text) { std::printf("%s\r\n", text); }
} Serial;
struct Bus {
  unsigned char data[6]; int left = 0; unsigned sample = 0;
  void begin() {}
  void beginTransmission(int) {}
  void write(int) {}
  void endTransmission() {}
  void requestFrom(int, int) {
    for (int k = 0; k < 3; k++) {
      std::uint16_t v = (std::uint16_t)(int)(sample * 7 + 1000 * k - 900);
      data[2 * k] = v >> 8; data[2 * k + 1] = v & 255;
    }
    left = 0; sample++;
  }
  int read() { return data[left++]; }
} Wire;
"""


def test_the_sketch_of_the_page_is_recognised_unaided(tmp_path):
    compiler = shutil.which("c++") or shutil.which("g++")
    if compiler is None:
        pytest.skip("no C++ compiler here")
    sketch = re.search(r"```cpp\n(.*?)```", PAGE.read_text(), re.DOTALL)[1]
    (tmp_path / "Wire.h").write_text(STUB)
    main = "int main() { setup(); for (int k = 0; k < 700; k++) loop(); }\n"
    (tmp_path / "sketch.cpp").write_text(sketch + main)
    flags = ["-Wall", "-Werror", "-I.", "sketch.cpp", "-o", "sketch"]
    subprocess.run([compiler, *flags], cwd=tmp_path, check=True, timeout=60)
    sent = subprocess.run([tmp_path / "sketch"], capture_output=True, check=True, timeout=20).stdout
    stream = LineStream("serial:x")
    blocks = [*stream.feed(sent[:20_000], 0.0), *stream.feed(sent[20_000:], 2.5), *stream.finish()]
    assert stream.format == "titles with units"
    assert stream.counts.damaged == stream.counts.lost == 0
    for k, axis in enumerate("xyz"):
        found = np.concatenate([block.columns[f"accel_{axis}"] for block in blocks])
        counts = 7.0 * np.arange(700) + 1000 * k - 900
        np.testing.assert_allclose(found, counts / 16384, atol=0.51e-5)
