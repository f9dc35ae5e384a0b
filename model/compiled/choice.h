/* Choices that do not depend on rounding (as in `model.arrays`), and percentiles. */
#ifndef CHOICE_H
#define CHOICE_H

#include "arena.h"

static const float NEARLY = 1e-5f, SAME_FREQUENCY = 1e-3f; /* Hz */

typedef struct {
    float score;
    int at, run;
} ranked;

static int by_score(const void *one, const void *other) {
    const ranked *a = one, *b = other;
    if (a->score != b->score) return a->score < b->score ? 1 : -1;
    return a->at - b->at;
}

static int by_run(const void *one, const void *other) {
    const ranked *a = one, *b = other;
    return a->run != b->run ? a->run - b->run : a->at - b->at;
}

/* Sort scores (count), highest first; nearly equal scores keep their order. */
SHARED void best_first(int *order, const float *scores, int count, arena *memory) {
    const arena mark = *memory;
    ranked *each = take(memory, count * sizeof(ranked));
    for (int i = 0; i < count; i++) each[i] = (ranked){.score = scores[i], .at = i};
    qsort(each, count, sizeof(ranked), by_score);
    for (int i = 1; i < count; i++) {
        float above = each[i - 1].score, below = each[i].score;
        int is_near = below == above || below >= above - NEARLY * fabsf(above);
        each[i].run = each[i - 1].run + !is_near;
    }
    qsort(each, count, sizeof(ranked), by_run);
    for (int i = 0; i < count; i++) order[i] = each[i].at;
    release(memory, mark);
}

/* Return the index of the first of the nearly highest scores. */
INLINE int best_of(const float *scores, int count) {
    float highest = scores[0];
    for (int i = 1; i < count; i++) highest = scores[i] > highest ? scores[i] : highest;
    for (int i = 0; i < count; i++)
        if (scores[i] == highest || scores[i] >= highest - NEARLY * fabsf(highest)) return i;
    return 0;
}

enum { FEW = 24 };

/* Return the value of a rank among values (count) by partial sorting (quickselect); reorders the values. */
SHARED float of_rank(float *values, int count, int rank) {
    int low = 0, high = count - 1;
    while (low < high) {
        float middle = values[(low + high) / 2];
        int i = low, j = high;
        while (i <= j) {
            while (values[i] < middle) i++;
            while (values[j] > middle) j--;
            if (i <= j) {
                float swapped = values[i];
                values[i++] = values[j], values[j--] = swapped;
            }
        }
        if (rank <= j) high = j;
        else if (rank >= i) low = i;
        else break;
    }
    return values[rank];
}

/* Find the value of a low rank among values (count) and the next higher one, by sorting only the lowest values. */
INLINE void of_low_rank(float *below, float *above, const float *values, int count, int rank) {
    float lowest[FEW + 1];
    const int kept = rank + 2 < count ? rank + 2 : count;
    int found = 0;
    for (int i = 0; i < count; i++) {
        if (found == kept && !(values[i] < lowest[kept - 1])) continue;
        int place = found < kept ? found++ : kept - 1;
        for (; place && values[i] < lowest[place - 1]; place--) lowest[place] = lowest[place - 1];
        lowest[place] = values[i];
    }
    *below = lowest[rank], *above = lowest[rank + 1 < kept ? rank + 1 : rank];
}

/* Return a percentile of values (count) with linear interpolation; reorders the values. */
SHARED float percentile(float *values, int count, float percent) {
    double place = (double)percent / 100 * (count - 1);
    int low = (int)place;
    float below, above;
    if (low + 2 <= FEW)
        of_low_rank(&below, &above, values, count, low);
    else {
        below = of_rank(values, count, low), above = low + 1 < count ? INFINITY : below;
        for (int i = low + 1; i < count; i++) above = values[i] < above ? values[i] : above;
    }
    return (float)(below + (place - low) * ((double)above - below));
}

#endif
