/* A plain JSON value as two texts at once: compact with sorted keys, to be hashed, and indented, to be read.
 *
 * Both are to the byte those of Python's json.dumps; each number and string is written once and copied. The two differ
 * in blanks, line breaks and the order of keys only: an object's items are written to the compact text as they come,
 * and put in order when the last is there.
 */
#include "_digits.h"
#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef struct {
    char *bytes;
    Py_ssize_t size, room;
} Text;

typedef struct {
    Text compact, indented;
} Texts;

/* One item of an object: its key as UTF-8, and where its compact text lies. */
typedef struct {
    const char *key;
    Py_ssize_t length, start, stop;
} Item;

/* Where `count` more bytes can be written; NULL with MemoryError set. */
static char *space(Text *text, Py_ssize_t count) {
    if (text->room - text->size < count) {
        const Py_ssize_t room = 2 * text->room + count;
        char *bytes = PyMem_Realloc(text->bytes, (size_t)room);
        if (bytes == NULL) {
            PyErr_NoMemory();
            return NULL;
        }
        text->bytes = bytes;
        text->room = room;
    }
    return text->bytes + text->size;
}

static int add(Text *text, const char *bytes, Py_ssize_t count) {
    char *out = space(text, count);
    if (out == NULL) return 0;
    memcpy(out, bytes, (size_t)count);
    text->size += count;
    return 1;
}

static int add_both(Texts *texts, const char *bytes, Py_ssize_t count) {
    return add(&texts->compact, bytes, count) && add(&texts->indented, bytes, count);
}

/* A line break of the indented text, and the indent. */
static int add_line(Texts *texts, int depth) {
    char *out = space(&texts->indented, 1 + (Py_ssize_t)depth);
    if (out == NULL) return 0;
    out[0] = '\n';
    memset(out + 1, ' ', (size_t)depth);
    texts->indented.size += 1 + (Py_ssize_t)depth;
    return 1;
}

/* A string in quotes, with escapes for what JSON does not allow as it is. */
static int add_string(Texts *texts, const char *utf8, Py_ssize_t length) {
    static const char hexadecimal[] = "0123456789abcdef", special[] = "\"\\\b\f\n\r\t", letter[] = "\"\\bfnrt";
    Text *compact = &texts->compact;
    const Py_ssize_t start = compact->size;
    char *out = space(compact, 6 * length + 2);
    if (out == NULL) return 0;
    *out++ = '"';
    for (Py_ssize_t i = 0; i < length; i++) {
        const char c = utf8[i];
        if ((unsigned char)c >= 0x20 && c != '"' && c != '\\') {
            *out++ = c;
            continue;
        }
        const char *found = c == '\0' ? NULL : strchr(special, c);
        *out++ = '\\';
        if (found != NULL) {
            *out++ = letter[found - special];
        } else {
            memcpy(out, "u00", 3);
            out[3] = hexadecimal[c >> 4];
            out[4] = hexadecimal[c & 15];
            out += 5;
        }
    }
    *out++ = '"';
    compact->size = out - compact->bytes;
    return add(&texts->indented, compact->bytes + start, compact->size - start);
}

static int add_float(Texts *texts, double value) {
    if (!isfinite(value)) {
        PyErr_SetString(PyExc_ValueError, "Out of range float values are not JSON compliant");
        return 0;
    }
    if (numbers_prepared()) {
        char digits[LONGEST];
        return add_both(texts, digits, print_number(value, digits) - digits);
    }
    char *digits = PyOS_double_to_string(value, 'r', 0, Py_DTSF_ADD_DOT_0, NULL);
    if (digits == NULL) return 0;
    const int added = add_both(texts, digits, (Py_ssize_t)strlen(digits));
    PyMem_Free(digits);
    return added;
}

static int add_integer(Texts *texts, PyObject *value) {
    PyObject *digits = PyObject_Repr(value);
    if (digits == NULL) return 0;
    Py_ssize_t length;
    const char *utf8 = PyUnicode_AsUTF8AndSize(digits, &length);
    const int added = utf8 != NULL && add_both(texts, utf8, length);
    Py_DECREF(digits);
    return added;
}

static int add_value(Texts *texts, PyObject *value, int depth);

static int add_array(Texts *texts, PyObject *values, int depth) {
    const int is_list = PyList_Check(values);
    const Py_ssize_t count = is_list ? PyList_Size(values) : PyTuple_Size(values);
    if (count == 0) return add_both(texts, "[]", 2);
    for (Py_ssize_t i = 0; i < count; i++) {
        PyObject *value = is_list ? PyList_GetItem(values, i) : PyTuple_GetItem(values, i);
        if (value == NULL || !add_both(texts, i == 0 ? "[" : ",", 1) || !add_line(texts, depth + 1) ||
            !add_value(texts, value, depth + 1)) {
            return 0;
        }
    }
    return add_line(texts, depth) && add_both(texts, "]", 1);
}

/* By code points, which is the order of the bytes of UTF-8. */
static int by_key(const void *first, const void *second) {
    const Item *a = first, *b = second;
    const int order = memcmp(a->key, b->key, (size_t)(a->length < b->length ? a->length : b->length));
    return order != 0 ? order : (a->length > b->length) - (a->length < b->length);
}

/* Put the compact texts of an object's items, which lie one behind the other with commas between, in order of the keys. */
static int sort_items(Text *compact, Item *items, Py_ssize_t count) {
    const Py_ssize_t start = items[0].start, size = compact->size - start;
    qsort(items, (size_t)count, sizeof(Item), by_key);
    char *sorted = PyMem_Malloc((size_t)size);
    if (sorted == NULL) {
        PyErr_NoMemory();
        return 0;
    }
    char *out = sorted;
    for (Py_ssize_t i = 0; i < count; i++) {
        if (i > 0) *out++ = ',';
        memcpy(out, compact->bytes + items[i].start, (size_t)(items[i].stop - items[i].start));
        out += items[i].stop - items[i].start;
    }
    memcpy(compact->bytes + start, sorted, (size_t)size);
    PyMem_Free(sorted);
    return 1;
}

static int add_item(Texts *texts, Item *item, PyObject *key, PyObject *value, int depth) {
    if (!PyUnicode_Check(key)) {
        PyErr_SetString(PyExc_TypeError, "keys must be str");
        return 0;
    }
    item->key = PyUnicode_AsUTF8AndSize(key, &item->length);
    item->start = texts->compact.size;
    if (item->key == NULL || !add_line(texts, depth) || !add_string(texts, item->key, item->length) ||
        !add_both(texts, ":", 1) || !add(&texts->indented, " ", 1) || !add_value(texts, value, depth)) {
        return 0;
    }
    item->stop = texts->compact.size;
    return 1;
}

static int add_object(Texts *texts, PyObject *object, int depth) {
    const Py_ssize_t count = PyDict_Size(object);
    if (count == 0) return add_both(texts, "{}", 2);
    Item *items = PyMem_Malloc(sizeof(Item) * (size_t)count);
    if (items == NULL) {
        PyErr_NoMemory();
        return 0;
    }
    int added = add_both(texts, "{", 1);
    PyObject *key, *value;
    Py_ssize_t position = 0;
    for (Py_ssize_t i = 0; added && i < count && PyDict_Next(object, &position, &key, &value); i++) {
        added = (i == 0 || add_both(texts, ",", 1)) && add_item(texts, items + i, key, value, depth + 1);
    }
    added = added && sort_items(&texts->compact, items, count) && add_line(texts, depth) && add_both(texts, "}", 1);
    PyMem_Free(items);
    return added;
}

static int add_value(Texts *texts, PyObject *value, int depth) {
    if (PyFloat_Check(value)) return add_float(texts, PyFloat_AsDouble(value));
    if (PyUnicode_Check(value)) {
        Py_ssize_t length;
        const char *utf8 = PyUnicode_AsUTF8AndSize(value, &length);
        return utf8 != NULL && add_string(texts, utf8, length);
    }
    if (value == Py_None) return add_both(texts, "null", 4);
    if (value == Py_True) return add_both(texts, "true", 4);
    if (value == Py_False) return add_both(texts, "false", 5);
    if (PyLong_CheckExact(value)) return add_integer(texts, value);
    const int is_object = PyDict_CheckExact(value);
    if (!is_object && !PyList_Check(value) && !PyTuple_Check(value)) {
        PyErr_Format(PyExc_TypeError, "%R is not JSON serializable", (PyObject *)Py_TYPE(value));
        return 0;
    }
    if (Py_EnterRecursiveCall(" while writing JSON")) return 0;
    const int added = is_object ? add_object(texts, value, depth) : add_array(texts, value, depth);
    Py_LeaveRecursiveCall();
    return added;
}

const char json_doc[] =
    "json(value) -> (compact, indented)\n\n"
    "A value of dict, list, tuple, str, float, int, bool and None as UTF-8 bytes twice: as of json.dumps with sort_keys,\n"
    "separators=(',', ':') and allow_nan=False, and with indent=1; ensure_ascii=False for both. ValueError: a number that\n"
    "is not finite, or a text that is no Unicode. TypeError: a value of another kind, or a key that is no str.";

PyObject *json_texts(PyObject *module, PyObject *value) {
    (void)module;
    Texts texts = {{NULL, 0, 0}, {NULL, 0, 0}};
    PyObject *both = NULL;
    if (add_value(&texts, value, 0)) {
        both = Py_BuildValue("y#y#", texts.compact.bytes, texts.compact.size, texts.indented.bytes, texts.indented.size);
    }
    PyMem_Free(texts.compact.bytes);
    PyMem_Free(texts.indented.bytes);
    return both;
}
