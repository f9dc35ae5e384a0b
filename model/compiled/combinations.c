/* The worst finger of combinations of tones: `model.table.combinations` in C. Lanes are drawn plates. */
#include "lanes.h"

typedef struct {
    int contents, fingers, draws;
    int low;                /* percentile: between the values of this rank and of the next, */
    float part;             /* this part of their distance above the lower one */
    const int *content;     /* (fingers): of which each is a target, contents if quiet, else -1 */
    const float *own;       /* (m, draws) power at the targets of each tone */
    const float *loudest;   /* (m, fingers, draws) power at the loudest point */
} tones;

static const float FAINT = 1e-20f;

INLINE lanes part_of(const float *from, size_t count) {
    lanes found = {0};
    memcpy(&found, from, count * sizeof(float));
    return found;
}

/* Values of work space. */
size_t combinations_space(const tones *on) { return on->draws / LANES + 1; }

/* worst (count): percentile of the least power ratio of combinations (count, contents) of tones. */
void worst_of_combinations(const tones *on, const int *combinations, int count, float *work, float *worst) {
    const size_t draws = on->draws, fingers = on->fingers, contents = on->contents;
    for (int each = 0; each < count; each++) {
        const int *tone = combinations + each * contents;
        for (size_t from = 0; from < draws; from += LANES) {
            size_t some = draws - from < LANES ? draws - from : LANES;
            lanes least = filled(INFINITY), weakest = filled(INFINITY);
            for (size_t j = 0; j < contents; j++)
                weakest = smaller(weakest, part_of(on->own + tone[j] * draws + from, some));
            for (size_t finger = 0; finger < fingers; finger++) {
                int of = on->content[finger];
                if (of < 0 || (of < (int)contents && contents == 1)) continue;
                lanes others = {0}, level = weakest;
                for (int j = 0; j < (int)contents; j++)
                    if (j != of) others += part_of(on->loudest + (tone[j] * fingers + finger) * draws + from, some);
                if (of < (int)contents) level = part_of(on->own + tone[of] * draws + from, some);
                least = smaller(least, level / larger(others, filled(FAINT)));
            }
            memcpy(work + from, &least, some * sizeof(float));
        }
        /* The smallest values, in ascending order. */
        float *smallest = work + draws;
        size_t kept = 0, wanted = on->low + 2;
        for (size_t d = 0; d < draws; d++) {
            if (kept == wanted && work[d] >= smallest[kept - 1]) continue;
            size_t at = kept < wanted ? kept++ : kept - 1;
            for (; at > 0 && smallest[at - 1] > work[d]; at--) smallest[at] = smallest[at - 1];
            smallest[at] = work[d];
        }
        float low = smallest[on->low];
        worst[each] = low + on->part * (smallest[kept - 1] - low);
    }
}
