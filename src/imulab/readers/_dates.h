/* Dates and times of day out of text, as whole nanoseconds. */
#ifndef IMULAB_DATES_H
#define IMULAB_DATES_H

#include <stdint.h>
#include <string.h>

enum { NOT_A_DATE = 3, EITHER_ORDER = 4 }; /* problems */
enum { DAY_FIRST = 1, MONTH_FIRST = 2 };    /* orders of a date with slashes; 0: as it fits */

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
    const int hour = end - *p > 1 && (*p)[1] == ':' ? some_digits(p, end, 1) : some_digits(p, end, 2);
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

/* A number of one to `most` digits at *p, which moves behind them; -1 if there is none. */
static int few_digits(const char **p, const char *end, int most) {
    int count = 0;
    while (count < most && *p + count < end && (*p)[count] >= '0' && (*p)[count] <= '9') count++;
    return count == 0 ? -1 : some_digits(p, end, count);
}

/* A date at *p as days since 1970 -> 0, NOT_A_DATE, or EITHER_ORDER where day and month may be either way round. */
static int calendar_date(const char **p, const char *end, int order, int64_t *day) {
    const char *first = *p;
    const int year = some_digits(p, end, 4);
    if (year >= 0) { /* 2024-12-11, 20241211, 2024/12/11 */
        const char sign = *p < end && (**p == '/' || **p == '.') ? **p : '-';
        const int signs = passes(p, end, sign), month = sign == '-' ? some_digits(p, end, 2) : few_digits(p, end, 2);
        if (signs != passes(p, end, sign)) return NOT_A_DATE;
        *day = days(year, month, sign == '-' ? some_digits(p, end, 2) : few_digits(p, end, 2));
        return *day == INT64_MIN ? NOT_A_DATE : 0;
    }
    *p = first;
    const int one = few_digits(p, end, 2);
    const char sign = *p < end ? **p : 0;
    if (one < 0 || !(sign == '/' || sign == '.' || sign == '-')) return NOT_A_DATE;
    ++*p;
    const int other = few_digits(p, end, 2);
    if (other < 0 || !passes(p, end, sign)) return NOT_A_DATE;
    const int last = some_digits(p, end, 4);
    if (order == 0 && sign == '.') return NOT_A_DATE; /* a damaged date, unless the layout says that such are meant */
    const int64_t day_first = days(last, other, one), month_first = days(last, one, other);
    if (order == 0 && day_first != month_first && day_first != INT64_MIN && month_first != INT64_MIN) return EITHER_ORDER;
    *day = order == DAY_FIRST || (order == 0 && day_first != INT64_MIN) ? day_first : month_first;
    return *day == INT64_MIN ? NOT_A_DATE : 0;
}

/* AM or PM at *p, after blanks, for a time of so many minutes since midnight: the minutes of the whole day, or -1. */
static int of_half_day(const char **p, const char *end, int minutes) {
    while (*p < end && **p == ' ') ++*p;
    if (end - *p < 2 || ((*p)[1] != 'M' && (*p)[1] != 'm')) return minutes;
    const char half = (char)(**p | 0x20);
    if (half != 'a' && half != 'p') return minutes;
    *p += 2;
    if (minutes / 60 < 1 || minutes / 60 > 12) return -1;
    return minutes % 720 + (half == 'p' ? 720 : 0);
}

/* Whether a time of day begins at p: digits and a colon. */
static int begins_with_time(const char *p, const char *end) {
    const int digits = end - p > 1 && p[1] >= '0' && p[1] <= '9' ? 2 : 1;
    return end - p > digits && p[0] >= '0' && p[0] <= '9' && p[digits] == ':';
}

/* Whether a stamp that `date` wrote is a time of day, or of 1970-01-01. */
static int is_time_of_day(const double *value) {
    int64_t stamp;
    memcpy(&stamp, value, sizeof stamp);
    return stamp >= 0 && stamp < INT64_C(86400000000000);
}

/* Date and time, or time of day alone, [p, end) -> nanoseconds since 1970, or since midnight, written as int64 to
 * `value`: ISO 8601, or a date with slashes of this order; UTC where no zone is given. The arrow of a serial monitor
 * behind it is passed over. */
static int date(const char *p, const char *end, int order, double *value) {
    while (p < end && (*p == ' ' || *p == '\t')) p++;
    while (end > p && (end[-1] == ' ' || end[-1] == '\t' || end[-1] == '\r')) end--;
    if (end - p >= 2 && end[-2] == '-' && end[-1] == '>') {
        end -= 2;
        while (end > p && end[-1] == ' ') end--;
    }
    if (end - p >= 2 && *p == '"' && end[-1] == '"') {
        p++;
        end--;
    }
    int64_t day = 0;
    if (!begins_with_time(p, end)) {
        const int problem = calendar_date(&p, end, order, &day);
        if (problem != 0) return problem;
        if (p == end || !(*p == 'T' || *p == 't' || *p == ' ')) return NOT_A_DATE;
        p++;
        while (p < end && *p == ' ') p++;
    }
    int colons = 0, second = 0;
    int minutes = clock_minutes(&p, end, &colons);
    if (minutes < 0) return NOT_A_DATE;
    int64_t nanoseconds = 0;
    if (p < end && (colons ? *p == ':' : *p >= '0' && *p <= '9')) {
        p += colons;
        second = some_digits(&p, end, 2);
        if (second < 0 || second > 60) return NOT_A_DATE;
        if (p < end && (*p == '.' || *p == ',' || (colons && *p == ':' && end - p > 3))) {
            const char *first = ++p;
            int64_t unit = 100000000;
            for (; p < end && *p >= '0' && *p <= '9'; p++, unit /= 10) nanoseconds += unit * (*p - '0');
            if (p == first || (first[-1] == ':' && p != first + 3)) return NOT_A_DATE;
        }
    }
    minutes = of_half_day(&p, end, minutes);
    if (minutes < 0) return NOT_A_DATE;
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
