#include "phantom.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "parameters.h"

#ifdef _WIN32
#include <wchar.h>
#endif

#define MAGIC "PALPHAN2"
#define HEADER (8u + 64u + 7u * 4u + 8u)
#define LARGEST 4000000

typedef struct {
    const unsigned char *at;
} Reader;

static uint32_t read_u32(Reader *r) {
    const unsigned char *b = r->at;
    r->at += 4;
    return (uint32_t)b[0] | (uint32_t)b[1] << 8 | (uint32_t)b[2] << 16 | (uint32_t)b[3] << 24;
}

static int32_t read_i32(Reader *r) {
    uint32_t bits = read_u32(r);
    int32_t value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static double read_f64(Reader *r) {
    uint64_t low = read_u32(r), bits = low | (uint64_t)read_u32(r) << 32;
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static double *read_reals(Reader *r, size_t count) {
    double *values = malloc((count ? count : 1) * sizeof *values);
    if (values) {
        for (size_t i = 0; i < count; i++) values[i] = read_f64(r);
    }
    return values;
}

static Breath *read_breaths(Reader *r, size_t count) {
    Breath *breaths = malloc((count ? count : 1) * sizeof *breaths);
    for (size_t k = 0; breaths && k < count; k++) {
        breaths[k].start = read_f64(r);
        breaths[k].inspiration = read_f64(r);
        breaths[k].expiration = read_f64(r);
        breaths[k].pause = read_f64(r);
        breaths[k].amplitude = read_f64(r);
    }
    return breaths;
}

static int32_t *read_integers(Reader *r, size_t count) {
    int32_t *values = malloc((count ? count : 1) * sizeof *values);
    if (values) {
        for (size_t i = 0; i < count; i++) values[i] = read_i32(r);
    }
    return values;
}

#ifdef _WIN32
/* fopen of Windows takes the code page of the machine, FMI gives UTF-8. */
static FILE *open_file(const char *path) {
    size_t length = strlen(path), k = 0;
    wchar_t *wide = malloc((length + 1) * sizeof *wide);
    FILE *file;
    if (!wide) return NULL;
    for (const unsigned char *b = (const unsigned char *)path; *b;) {
        uint32_t code = *b++;
        int more = code >= 0xF0 ? 3 : code >= 0xE0 ? 2 : code >= 0xC0 ? 1 : 0;
        if (more) code &= 0x3Fu >> more;
        while (more-- > 0 && (*b & 0xC0) == 0x80) code = code << 6 | (*b++ & 0x3Fu);
        if (code >= 0x10000) {
            code -= 0x10000;
            wide[k++] = (wchar_t)(0xD800 + (code >> 10));
            wide[k++] = (wchar_t)(0xDC00 + (code & 0x3FF));
        } else {
            wide[k++] = (wchar_t)code;
        }
    }
    wide[k] = 0;
    file = _wfopen(wide, L"rb");
    free(wide);
    return file;
}
#else
static FILE *open_file(const char *path) { return fopen(path, "rb"); }
#endif

static unsigned char *read_file(const char *path, size_t *size) {
    FILE *file = open_file(path);
    unsigned char *bytes = NULL;
    long end;
    if (!file) return NULL;
    if (fseek(file, 0, SEEK_END) == 0 && (end = ftell(file)) > 0 && fseek(file, 0, SEEK_SET) == 0) {
        *size = (size_t)end;
        bytes = malloc(*size);
        if (bytes && fread(bytes, 1, *size, file) != *size) {
            free(bytes);
            bytes = NULL;
        }
    }
    fclose(file);
    return bytes;
}

static int all_finite(const double *values, size_t count) {
    for (size_t i = 0; i < count; i++) {
        if (!isfinite(values[i])) return 0;
    }
    return 1;
}

static int all_below(const int32_t *values, size_t count, int32_t limit) {
    for (size_t i = 0; i < count; i++) {
        if (values[i] < 0 || values[i] >= limit) return 0;
    }
    return 1;
}

static int is_not_negative(double value) { return isfinite(value) && value >= 0; }

/* Whether the breaths follow each other, and take some time. */
static int breaths_follow(const Phantom *p) {
    for (int32_t k = 0; k < p->breaths; k++) {
        const Breath *b = p->breath + k;
        if (!isfinite(b->start) || !is_not_negative(b->amplitude)) return 0;
        if (!is_not_negative(b->inspiration) || !is_not_negative(b->expiration) || !is_not_negative(b->pause)) return 0;
        if (!(b->inspiration + b->expiration + b->pause > 0) || (k && !(b->start > b[-1].start))) return 0;
    }
    return 1;
}

/* Names the first thing that is wrong, or NULL. */
static const char *fault(const Phantom *p) {
    const size_t n = (size_t)p->n, nnz = (size_t)p->nnz;
    if (!all_finite(p->start, (size_t)p->values)) return "start values are not finite";
    if (!all_finite(p->vertices, 3 * n) || !all_finite(p->normals, 3 * n)) return "vertices or normals are not finite";
    if (!all_finite(p->laplacian, nnz) || !all_finite(p->breathing, n)) return "Laplacian or breathing is not finite";
    for (size_t i = 0; i < n; i++) {
        if (!(p->areas[i] > 0) || !isfinite(p->areas[i])) return "an area is not positive";
        if (!(p->background[i] > 0) || !isfinite(p->background[i])) return "a stiffness is not positive";
        if (!is_not_negative(p->stiffening[i]) || !is_not_negative(p->tension[i])) return "stiffening or tension is negative";
        if (p->first[i] > p->first[i + 1]) return "rows of the Laplacian are not in order";
    }
    if (!breaths_follow(p)) return "breaths are not in order";
    if (p->first[0] != 0 || p->first[n] != p->nnz) return "rows of the Laplacian do not add up";
    if (!all_below(p->column, nnz, p->n) || !all_below(p->triangles, 3 * (size_t)p->m, p->n) ||
        !all_below(p->sample, (size_t)p->samples, p->n)) {
        return "an index is out of range";
    }
    for (size_t i = 0; i < n; i++) {
        if (!p->fixed[i]) return NULL;
    }
    return "no vertex can move";
}

void phantom_free(Phantom *p) {
    if (!p) return;
    free(p->start);
    free(p->vertices);
    free(p->normals);
    free(p->areas);
    free(p->background);
    free(p->stiffening);
    free(p->tension);
    free(p->breathing);
    free(p->breath);
    free(p->laplacian);
    free(p->first);
    free(p->column);
    free(p->triangles);
    free(p->sample);
    free(p->fixed);
    free(p);
}

static Phantom *parse(const unsigned char *bytes, size_t size, const char **wrong) {
    Reader r = {bytes};
    Phantom *p;
    size_t n, nnz, m, samples, values, breaths, expected;
    *wrong = "not a phantom file";
    if (size < HEADER || memcmp(bytes, MAGIC, 8) != 0) return NULL;
    p = calloc(1, sizeof *p);
    *wrong = "out of memory";
    if (!p) return NULL;
    memcpy(p->token, bytes + 8, 64);
    r.at += 72;
    p->n = read_i32(&r);
    p->nnz = read_i32(&r);
    p->m = read_i32(&r);
    p->samples = read_i32(&r);
    p->values = read_i32(&r);
    p->branches = read_i32(&r);
    p->breaths = read_i32(&r);
    p->median_background = read_f64(&r);
    *wrong = "a count is out of range";
    if (p->n < 3 || p->n > LARGEST || p->nnz < p->n || p->nnz > 16 * LARGEST || p->m < 1 || p->m > 2 * LARGEST ||
        p->samples < 0 || p->samples > p->n || p->values < 0 || p->values > 1000 || p->branches < 0 ||
        p->branches > BRANCHES || p->breaths < 0 || p->breaths > LARGEST || !(p->median_background > 0)) {
        phantom_free(p);
        return NULL;
    }
    n = (size_t)p->n, nnz = (size_t)p->nnz, m = (size_t)p->m, samples = (size_t)p->samples, values = (size_t)p->values;
    breaths = (size_t)p->breaths;
    expected = HEADER + 8 * (values + 11 * n + nnz + 5 * breaths) + 4 * (n + 1 + nnz + 3 * m + samples) + n;
    *wrong = "the size does not fit its header";
    if (size != expected) {
        phantom_free(p);
        return NULL;
    }
    p->start = read_reals(&r, values);
    p->vertices = read_reals(&r, 3 * n);
    p->normals = read_reals(&r, 3 * n);
    p->areas = read_reals(&r, n);
    p->background = read_reals(&r, n);
    p->stiffening = read_reals(&r, n);
    p->tension = read_reals(&r, n);
    p->breathing = read_reals(&r, n);
    p->laplacian = read_reals(&r, nnz);
    p->breath = read_breaths(&r, breaths);
    *wrong = "out of memory";
    if (p->start && p->vertices && p->normals && p->areas && p->background && p->stiffening && p->tension && p->breathing &&
        p->laplacian && p->breath) {
        p->first = read_integers(&r, n + 1);
        p->column = read_integers(&r, nnz);
        p->triangles = read_integers(&r, 3 * m);
        p->sample = read_integers(&r, samples);
        p->fixed = malloc(n);
        if (p->first && p->column && p->triangles && p->sample && p->fixed) {
            memcpy(p->fixed, r.at, n);
            *wrong = fault(p);
        }
    }
    if (*wrong) {
        phantom_free(p);
        return NULL;
    }
    return p;
}

Phantom *phantom_read(const char *path, char *error, size_t room) {
    size_t size = 0;
    unsigned char *bytes = read_file(path, &size);
    const char *wrong = NULL;
    Phantom *phantom;
    if (!bytes) {
        snprintf(error, room, "cannot read the phantom from %s", path);
        return NULL;
    }
    phantom = parse(bytes, size, &wrong);
    free(bytes);
    if (!phantom) snprintf(error, room, "%s: %s", path, wrong);
    return phantom;
}
