"""The bias in the minutes after power-on: a table over time, selected by the temperature at power-on."""
