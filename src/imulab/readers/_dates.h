/* Dates of ISO 8601 out of text, as whole nanoseconds. */
#ifndef IMULAB_DATES_H
#define IMULAB_DATES_H

#include <stdint.h>
#include <string.h>

enum { NOT_A_DATE = 3 };

/* `count` digits at *p, which moves behind them, as a number; -1 if they are not there. */
static int some_digits(const char **p, const char *end, int count) {
    int value = 0;
    if (end - *p < count) return -1;
    for (; count > 0; count--, ++*p) {
        if (**p < '0' || **p > '9') return -1;
        value = 10 * value + (**p - '0');
    }
    return value;
}

/* Passes over `sign` at *p if it is there. */
static int passes(const char **p, const char *end, char sign) {
    const int there = *p < end && **p == sign;
    *p += there;
    return there;
}

/* Hours and minutes at *p, as minutes; the colon between them may be left out; -1 if they are not there. */
static int clock_minutes(const char **p, const char *end, int *colons) {
    const int hour = some_digits(p, end, 2);
    if (hour < 0 || hour > 23) return -1;
    *colons = passes(p, end, ':');
    const int minute = some_digits(p, end, 2);
    return minute < 0 || minute > 59 ? -1 : 60 * hour + minute;
}

/* Days from 1970-01-01 to a date of the Gregorian calendar, or INT64_MIN (H. Hinnant, "chrono-compatible low-level date
 * algorithms", 2021). */
static int64_t days(int year, int month, int day) {
    static const int LENGTHS[] = {31, 28, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31};
    const int leap = year % 4 == 0 && (year % 100 != 0 || year % 400 == 0);
    if (year < 1700 || year > 2200 || month < 1 || month > 12 || day < 1) return INT64_MIN;
    if (day > LENGTHS[month - 1] + (leap && month == 2)) return INT64_MIN;
    const int y = year - (month <= 2), era = y / 400, of_era = y % 400;
    const int of_year = (153 * (month + (month > 2 ? -3 : 9)) + 2) / 5 + day - 1;
    return (int64_t)era * 146097 + of_era * 365 + of_era / 4 - of_era / 100 + of_year - 719468;
}

/* ISO 8601 date and time [p, end) -> nanoseconds since 1970, written as int64 to `value`; UTC where no zone is given. */
static int date(const char *p, const char *end, double *value) {
    while (p < end && (*p == ' ' || *p == '\t')) p++;
    while (end > p && (end[-1] == ' ' || end[-1] == '\t' || end[-1] == '\r')) end--;
    if (end - p >= 2 && *p == '"' && end[-1] == '"') {
        p++;
        end--;
    }
    const int year = some_digits(&p, end, 4), dashes = passes(&p, end, '-'), month = some_digits(&p, end, 2);
    if (dashes != passes(&p, end, '-')) return NOT_A_DATE;
    const int64_t day = days(year, month, some_digits(&p, end, 2));
    if (day == INT64_MIN || p == end || !(*p == 'T' || *p == 't' || *p == ' ')) return NOT_A_DATE;
    p++;
    int colons = 0, second = 0;
    const int minutes = clock_minutes(&p, end, &colons);
    if (minutes < 0) return NOT_A_DATE;
    int64_t nanoseconds = 0;
    if (p < end && (colons ? *p == ':' : *p >= '0' && *p <= '9')) {
        p += colons;
        second = some_digits(&p, end, 2);
        if (second < 0 || second > 60) return NOT_A_DATE;
        if (p < end && (*p == '.' || *p == ',')) {
            const char *first = ++p;
            int64_t unit = 100000000;
            for (; p < end && *p >= '0' && *p <= '9'; p++, unit /= 10) nanoseconds += unit * (*p - '0');
            if (p == first) return NOT_A_DATE;
        }
    }
    while (p < end && *p == ' ') p++;
    int zone = 0;
    if (p < end && (*p == '+' || *p == '-')) {
        const int west = *p++ == '-';
        if (end - p == 2) {
            zone = some_digits(&p, end, 2);
            if (zone < 0 || zone > 23) return NOT_A_DATE;
            zone *= 60;
        } else {
            zone = clock_minutes(&p, end, &colons);
            if (zone < 0) return NOT_A_DATE;
        }
        if (west) zone = -zone;
    } else if (p < end && (*p == 'Z' || *p == 'z')) {
        p++;
    }
    if (p != end) return NOT_A_DATE;
    const int64_t stamp = ((day * 1440 + minutes - zone) * 60 + second) * INT64_C(1000000000) + nanoseconds;
    memcpy(value, &stamp, sizeof stamp);
    return 0;
}

#endif
