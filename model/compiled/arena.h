/* Memory of one kernel call: a stack of chunks, released down to a mark or completely. */
#ifndef ARENA_H
#define ARENA_H

#include <setjmp.h>
#include <stdlib.h>

#include "lanes.h"

enum { ALIGNMENT = 64, CHUNK = 1 << 20, NO_MEMORY = -1 };

typedef struct chunk {
    struct chunk *before;
    char *end;
} chunk;

typedef struct {
    chunk *last;
    char *at;
    jmp_buf *failed; /* jump target when memory runs out */
} arena;

static __attribute__((unused)) void *take(arena *from, size_t bytes) {
    bytes = (bytes + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT;
    if (!from->last || (size_t)(from->last->end - from->at) < bytes) {
        /* Each chunk is twice as large as the previous one, since the C library keeps freed memory for reuse. */
        size_t before = from->last ? (size_t)(from->last->end - (char *)from->last) : CHUNK / 2;
        size_t size = ALIGNMENT + bytes > 2 * before ? ALIGNMENT + bytes : 2 * before;
        void *more;
        if (posix_memalign(&more, ALIGNMENT, size)) longjmp(*from->failed, 1);
        *(chunk *)more = (chunk){.before = from->last, .end = (char *)more + size};
        from->last = more, from->at = (char *)more + ALIGNMENT;
    }
    void *found = from->at;
    from->at += bytes;
    return found;
}

INLINE value *values(arena *from, size_t count) { return take(from, count * sizeof(value)); }

INLINE float *floats(arena *from, size_t count) { return take(from, count * sizeof(float)); }

INLINE int *integers(arena *from, size_t count) { return take(from, count * sizeof(int)); }

/* Release everything allocated since the arena was copied to `mark`. */
static __attribute__((unused)) void release(arena *of, arena mark) {
    while (of->last != mark.last) {
        chunk *more = of->last;
        of->last = more->before;
        free(more);
    }
    of->at = mark.at;
}

#endif
