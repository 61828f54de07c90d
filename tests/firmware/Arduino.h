// As much of Arduino's core as sketches of exported units use, on standard input and output.
#ifndef ARDUINO_STUB_H
#define ARDUINO_STUB_H
#include <stdint.h>
#include <stdio.h>

class StubSerial {
 public:
  void begin(unsigned long) {}
  int available() {
    int next = getchar();
    while (next == ' ' || next == '\n') next = getchar();
    if (next != EOF) ungetc(next, stdin);
    return next != EOF;
  }
  float parseFloat() {
    float value = 0;
    if (scanf("%f", &value) != 1) value = 0;
    return value;
  }
  void print(double value, int digits) { printf("%.*f", digits, value); }
  void print(char text) { putchar(text); }
  void println(const char *text = "") { puts(text); }
};

static StubSerial Serial;
void setup();
void loop();
#endif
