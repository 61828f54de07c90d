"""Numbers as the lines of C that vectors.h is made of."""

import math

LINES = []


def number(x):
    x = float(x)
    if math.isnan(x):
        return "VNAN"
    return f"R({x!r})"


def nested(values):
    """A C initialiser, broken into lines of readable length."""
    if not isinstance(values, (list, tuple)):
        return number(values)
    inner, line = "", 0
    for value in values:
        text = nested(value) + ","
        fresh = isinstance(value, (list, tuple)) or line + len(text) > 110
        inner += ("\n" if fresh else " ") + text
        line = len(text) if fresh else line + 1 + len(text)
    return "{" + inner.strip() + "}"


def shape(values):
    return f"[{len(values)}]" + shape(values[0]) if isinstance(values, (list, tuple)) else ""


def emit(name, values):
    LINES.append(f"static const il_real {name}{shape(values)} = {nested(values)};")


def emit_bytes(name, data):
    LINES.append(f"static const uint8_t {name}[{len(data)}] = {{")
    LINES.extend("    " + ", ".join(map(str, data[i : i + 28])) + "," for i in range(0, len(data), 28))
    LINES.append("};")


def emit_words(name, words):
    LINES.append(f"static const uint32_t {name}[{len(words)}] = {{{', '.join(f'{w}u' for w in words)}}};")
