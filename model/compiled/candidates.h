/* Candidate tones: a ranking of the frequencies, then the best tones of each content. */
#ifndef CANDIDATES_H
#define CANDIDATES_H

#include "answer.h"

/* Candidates (count): content, band and table row of each, its score, and its weights (count, n). */
typedef struct {
    int count;
    int *content, *band, *rows;
    float *scores, *weights;
} candidates;

/* Search results at rows (count): best score, best score of weights that miss the level, upper bound, and weights
 * (count, n). */
typedef struct {
    float *score, *missed, *bound, *weights;
} rows_found;

SHARED rows_found new_rows(size_t count, size_t n, arena *memory) {
    return (rows_found){.score = floats(memory, count), .missed = floats(memory, count), .bound = floats(memory, count),
                        .weights = floats(memory, 2 * count * n)};
}

INLINE void rows_at(int *rows, const int *all, int first, int count) {
    for (int l = 0; l < LANES; l++) rows[l] = all[first + l < count ? first + l : count - 1];
}

/* Mark the fingers that a content must not reach; return their number. */
SHARED size_t find_others(char *is_other, const question *of, size_t content, size_t k) {
    memset(is_other, 0, k);
    for (int i = 0; i < of->quiet_count; i++) is_other[of->quiet[i]] = 1;
    for (int i = 0; i < of->starts[of->contents]; i++)
        is_other[of->targets[i]] = i < of->starts[content] || i >= of->starts[content + 1];
    size_t count = 0;
    for (size_t finger = 0; finger < k; finger++) count += is_other[finger];
    return count;
}

/* Find the rows with the highest bounds for a single target, ascending, at most `kept`; return their number. The
 * bounds are computed from one form of all other fingers together. */
SHARED int ranked_rows(int *chosen_rows, const plates *on, const rules *by, const question *of, arena *memory) {
    const size_t n = on->n, k = on->k;
    const arena mark = *memory;
    char *is_other = take(memory, k);
    const int others = (int)find_others(is_other, of, 0, k), own = of->targets[0];
    const int count = of->rows, is_coarse = others > by->max_by_point, p = is_coarse ? 1 : of->few;
    float *weights = floats(memory, k * p), *mean = floats(memory, p);
    for (size_t i = 0; i < k * p; i++) {
        float share = is_coarse ? 1 : of->few_weights[i];
        if ((int)i / p == own) mean[i % p] = share;
        weights[i] = is_other[i / p] ? share / (float)others : 0;
    }
    const grouped all = {.groups = 1, .p = k * p, .others = by->others, .gain_variance = by->gain_variance,
                         .ridge = by->ridge, .points = is_coarse ? on->centers : of->few_points, .weights = weights,
                         .error = by->search_error, .shares = by->shares,
                         .touch_steps = is_coarse ? NULL : of->touch_steps};
    formed found = new_forms(on, &all, memory);
    best reached = {.weights = values(memory, n), .score = ZERO.re, .missed = ZERO.re, .bound = ZERO.re};
    value *target = values(memory, n);
    const value *const forms[1] = {found.power};
    rows_found at = new_rows(count, n, memory);
    for (int first = 0; first < count; first += LANES) {
        int rows[LANES], some = count - first < LANES ? count - first : LANES;
        rows_at(rows, of->row, first, count);
        find_forms(&found, on, &all, rows, memory);
        memset(target, 0, n * sizeof(value));
        for (int i = 0; i < p; i++)
            for (size_t e = 0; e < n; e++) {
                const value from = found.fields[(own * p + i) * n + e];
                target[e].re += mean[i] * from.re, target[e].im += mean[i] * from.im;
            }
        lanes wanted;
        load_real(&wanted, by->threshold, 1, rows);
        const searched here = {.n = n, .targets = 1, .quiet = 1, .phases = by->phases, .wanted = of->level[0] * wanted,
                               .target = target, .forms = forms};
        search(&reached, &here, &by->one_finger, memory);
        store_real(at.score + first, &reached.score, 1, some);
        store_real(at.bound + first, &reached.bound, 1, some);
    }
    int *order = integers(memory, count), reaching = 0, missing = 0;
    best_first(order, at.bound, count, memory);
    char *is_kept = take(memory, count);
    for (int i = 0; i < count; i++) is_kept[i] = 0;
    /* First the rows that would beat the best one if they reached the level. */
    for (int i = 0; i < count && missing < by->missing && at.score[order[i]] <= 0; i++) is_kept[order[i]] = 1, missing++;
    for (int i = 0; i < count && reaching < by->kept - missing; i++)
        if (at.score[order[i]] > 0) is_kept[order[i]] = 1, reaching++;
    int kept = 0;
    for (int i = 0; i < count; i++)
        if (is_kept[i]) chosen_rows[kept++] = of->row[i];
    release(memory, mark);
    return kept;
}

/* Clear the entries of ERAs outside a group in rows (count, n). */
INLINE void among(value *rows, size_t count, const int *group, int own, size_t n) {
    for (size_t i = 0; i < count * n; i++)
        if (group[i % n] != own) rows[i] = ZERO;
}

/* Clear the off-diagonal entries of ERAs outside a group in a form (n, n). */
INLINE void form_among(value *form, const int *group, int own, size_t n) {
    for (size_t i = 0; i < n * n; i++)
        if (i / n != i % n && (group[i / n] != own || group[i % n] != own)) form[i] = ZERO;
}

/* Return the search problem of a content at LANES rows for a group of ERAs. by_point: other fingers count by their rim
 * points instead of by their mean. */
SHARED searched forms_of(const formed *found, const plates *on, const rules *by, const question *of, const int *rows,
                         size_t content, int group, int by_point, float level, float margin, arena *memory) {
    const size_t n = on->n, k = on->k, first = of->starts[content], count = of->starts[content + 1] - first;
    value *target = values(memory, count * n), *expected_power = values(memory, count * n * n);
    char *is_other = take(memory, k);
    const size_t others = find_others(is_other, of, content, k);
    lanes *error = take(memory, n * sizeof(lanes)), *harmonic = take(memory, n * sizeof(lanes));
    load_real(error, by->error, n, rows);
    load_real(harmonic, by->search_error, n, rows);
    for (size_t e = 0; e < n; e++) harmonic[e] -= error[e]; /* is felt, but does not make a target's level uncertain */
    memset(target, 0, count * n * sizeof(value));
    for (size_t t = 0; t < count; t++) {
        const size_t finger = of->targets[first + t];
        value *mean = target + t * n;
        for (int i = 0; i < of->few; i++)
            for (size_t e = 0; e < n; e++) {
                const value from = found->fields[(finger * of->few + i) * n + e];
                const float share = of->few_weights[finger * of->few + i];
                mean[e].re += share * from.re, mean[e].im += share * from.im;
            }
        /* The variation of the field over a target does not make its level uncertain. */
        for (size_t u = 0; u < n; u++)
            for (size_t v = u; v < n; v++)
                expected_power[(t * n + u) * n + v] =
                    add_conjugate_product(found->uncertain[(finger * n + u) * n + v], mean[u], mean[v]);
        for (size_t e = 0; e < n; e++) expected_power[(t * n + e) * n + e].re -= harmonic[e];
    }
    const value **forms = take(memory, (others + 1) * sizeof(value *));
    const int is_deep = !by_point && by->is_deep && others && (int)others <= by->max_by_point;
    const size_t points = by_point ? by->rim_count : 0, few = is_deep ? of->few : 0, fine = is_deep ? of->fine : 0;
    value *at = values(memory, others * points * n), *at_few = values(memory, others * few * n);
    value *at_fine = values(memory, others * fine * n);
    size_t q = 0;
    for (size_t finger = 0; finger < k; finger++) {
        if (!is_other[finger]) continue;
        forms[q] = (by_point ? found->uncertain : found->power) + finger * n * n;
        for (size_t i = 0; i < points; i++)
            memcpy(at + (q * points + i) * n, found->fine + (finger * of->fine + by->rim[i]) * n, n * sizeof(value));
        for (size_t i = 0; i < few; i++)
            for (size_t e = 0; e < n; e++)
                at_few[(q * few + i) * n + e] = scaled(found->fields[(finger * few + i) * n + e],
                                                       filled(sqrtf(of->few_weights[finger * few + i])));
        if (fine) memcpy(at_fine + q * fine * n, found->fine + finger * fine * n, fine * n * sizeof(value));
        q++;
    }
    if (!others) {
        value *rest = values(memory, n * n);
        load(rest, of->background, n * n, rows);
        for (size_t e = 0; e < n; e++) rest[e * n + e] = scaled(rest[e * n + e], filled(1 + by->gain_variance));
        forms[q++] = rest;
    }
    for (size_t form = 0; by->groups > 1 && form < q; form++) {
        value *own = values(memory, n * n);
        memcpy(own, forms[form], n * n * sizeof(value));
        form_among(own, by->group, group, n);
        forms[form] = own;
    }
    for (size_t t = 0; by->groups > 1 && t < count; t++) form_among(expected_power + t * n * n, by->group, group, n);
    if (by->groups > 1) {
        among(target, count, by->group, group, n);
        among(at, others * points, by->group, group, n);
        among(at_few, others * few, by->group, group, n);
        among(at_fine, others * fine, by->group, group, n);
    }
    lanes wanted;
    load_real(&wanted, by->threshold, 1, rows);
    return (searched){.n = n, .targets = count, .quiet = q, .points = points, .few = few, .fine = fine,
                      .phases = by->phases, .margin = margin, .wanted = level * wanted, .target = target,
                      .target_power = expected_power, .forms = forms, .at_points = at, .few_fields = at_few,
                      .fine_fields = at_fine};
}

INLINE float highest_score(const float *scores, int first, int end) {
    float found = 0;
    for (int i = first; i < end; i++) found = scores[i] > found ? scores[i] : found;
    return found;
}

/* Search rows `first` to `end` for the best weights. Rows that miss the level are searched again with methods that
 * limit weights to full stroke. Return whether a row that misses the level would still score best. */
SHARED int search_rows(rows_found *to, searched *blocks, const rules *by, int first, int end, arena *memory) {
    const size_t n = blocks[first / LANES].n;
    const arena mark = *memory;
    best found = {.weights = values(memory, n), .score = ZERO.re, .missed = ZERO.re, .bound = ZERO.re};
    float score[LANES], missed[LANES], bound[LANES], *weights = floats(memory, 2 * LANES * n);
    int limited = 0;
    for (int pass = 0; pass < 4; pass++) {
        const float highest = pass ? highest_score(to->score, first, end) : 0;
        limited = 0;
        for (int i = first; pass && i < end; i++) limited |= is_limited(to->score[i], to->missed[i], highest);
        if (pass && !limited) break;
        for (int block = first / LANES; block * LANES < end; block++) {
            int open[LANES], any = 0;
            for (int l = 0; l < LANES; l++) {
                int row = block * LANES + l, is_in = row >= first && row < end;
                open[l] = is_in && (!pass || is_limited(to->score[row], to->missed[row], highest));
                any |= open[l];
            }
            if (!any) continue;
            const method *method = pass ? by->within + pass - 1 : constraints(blocks + block) > 1 ? &by->several : &by->one_finger;
            search(&found, blocks + block, method, memory);
            store_real(score, &found.score, 1, LANES);
            store_real(missed, &found.missed, 1, LANES);
            store_real(bound, &found.bound, 1, LANES);
            store(weights, found.weights, n, LANES);
            for (int l = 0; l < LANES; l++) {
                const int row = block * LANES + l;
                if (!open[l]) continue;
                to->score[row] = score[l];
                to->missed[row] = pass ? fmaxf(to->missed[row], missed[l]) : missed[l];
                to->bound[row] = pass ? fminf(to->bound[row], bound[l]) : bound[l];
                memcpy(to->weights + 2 * row * n, weights + 2 * l * n, 2 * n * sizeof(float));
            }
        }
    }
    const float highest = highest_score(to->score, first, end);
    limited = 0;
    for (int i = first; i < end; i++) limited |= is_limited(to->score[i], to->missed[i], highest);
    release(memory, mark);
    return limited;
}

/* Return the highest amplitude at the weakest target, relative to the threshold, over rows `first` to `end`. */
SHARED float highest_level(searched *blocks, const rules *by, const int *all, int count, int first, int end, arena *memory) {
    const arena mark = *memory;
    best found = {.weights = values(memory, blocks[first / LANES].n), .score = ZERO.re, .missed = ZERO.re,
                  .bound = ZERO.re};
    float highest = 0;
    for (int block = first / LANES; block * LANES < end; block++) {
        int rows[LANES];
        lanes threshold, least;
        rows_at(rows, all, block * LANES, count);
        load_real(&threshold, by->threshold, 1, rows);
        search(&found, blocks + block, by->within + 2, memory);
        lanes level = amplitude(&least, blocks + block, found.weights) / threshold;
        for (int l = 0; l < LANES; l++)
            if (block * LANES + l >= first && block * LANES + l < end) highest = fmaxf(highest, level[l]);
    }
    release(memory, mark);
    return highest;
}

/* Append a content's candidates in a band: the two best scores, then the best ones at separate frequencies. */
SHARED void keep_apart(candidates *to, const rows_found *found, const rules *by, const question *of, int content, int band,
                       const int *rows, int first, int end, size_t n, arena *memory) {
    const arena mark = *memory;
    const int most = of->candidates, start = to->count;
    int *order = integers(memory, end - first);
    best_first(order, found->score + first, end - first, memory);
    for (int i = 0; i < end - first && to->count - start < most; i++) {
        const int at = first + order[i];
        int is_apart = 1;
        if (found->score[at] <= 0) break;
        for (int other = start; other < to->count; other++)
            is_apart &= fabsf(by->frequencies[to->rows[other]] - by->frequencies[rows[at]]) >= of->apart - SAME_FREQUENCY;
        if (!is_apart && of->contents > 1 && to->count - start >= 2) continue;
        to->content[to->count] = content, to->band[to->count] = band, to->rows[to->count] = rows[at];
        to->scores[to->count] = found->score[at];
        memcpy(to->weights + 2 * n * to->count++, found->weights + 2 * n * at, 2 * n * sizeof(float));
    }
    release(memory, mark);
}

/* Find the candidates of all contents in all bands, at rows (count); return whether a level was hard to reach. */
SHARED int find_candidates(candidates *to, const plates *on, const rules *by, const question *of, const int *rows, int count,
                           arena *memory) {
    const size_t n = on->n, k = on->k;
    const int blocks = (count + LANES - 1) / LANES;
    int has_fine = 0;
    char *is_other = take(memory, k), *is_fine = take(memory, k);
    memset(is_fine, 0, k);
    for (int content = 0; content < of->contents; content++) {
        if ((int)find_others(is_other, of, content, k) > by->max_by_point) continue;
        has_fine = 1;
        for (size_t finger = 0; finger < k; finger++) is_fine[finger] |= is_other[finger];
    }
    const grouped each = {.groups = k, .p = of->few, .fine = has_fine ? k * of->fine : 0, .others = by->others,
                          .gain_variance = by->gain_variance, .ridge = by->ridge, .points = of->few_points,
                          .fine_points = of->fine_points, .weights = of->few_weights, .error = by->search_error,
                          .shares = by->shares, .is_fine = is_fine, .touch_steps = of->touch_steps,
                          .rim = by->is_deep ? 0 : by->rim[1]};
    formed *found = take(memory, blocks * sizeof(formed));
    searched *forms = take(memory, blocks * sizeof(searched));
    rows_found at = new_rows(blocks * LANES, n, memory);
    int limited = 0;
    for (int block = 0; block < blocks; block++) {
        int some[LANES];
        rows_at(some, rows, block * LANES, count);
        found[block] = new_forms(on, &each, memory);
        find_forms(found + block, on, &each, some, memory);
    }
    for (int content = 0; content < of->contents; content++)
        for (int band = 0; band < of->bands; band++) {
            const int *ends = of->band + 2 * (content * of->bands + band);
            const int first = of->is_ranked ? 0 : ends[0], end = of->is_ranked ? count : ends[1];
            const int others = (int)find_others(is_other, of, content, k), before = to->count;
            const int ways = others > 0 && others <= by->max_by_point ? 2 : 1;
            const arena mark = *memory;
            /* First only groups of ERAs that reach the level; if none does, all groups. */
            for (int is_any = by->groups == 1; is_any < 2 && to->count == before; is_any++)
                for (int group = 0; group < by->groups; group++) {
                    const int start = to->count;
                    float level = of->level[content] * (float)of->contents, margin = by->margin;
                    for (int way = 0; way < ways && (!way || to->count > start); way++) {
                        for (int tries = 0;; tries++) { /* with the margin, then without it, then near the highest
                                                         * level */
                            int some[LANES];
                            for (int block = first / LANES; block * LANES < end; block++) {
                                rows_at(some, rows, block * LANES, count);
                                forms[block] = forms_of(found + block, on, by, of, some, content, group, way, level, margin, memory);
                            }
                            int is_hard = search_rows(&at, forms, by, first, end, memory);
                            limited |= is_hard && !way;
                            if (way || !is_any || tries == 2 || highest_score(at.score, first, end) > 0) break;
                            margin = 0, limited = 1;
                            if (!tries) continue;
                            for (int block = first / LANES; block * LANES < end; block++)
                                forms[block].wanted = ZERO.re, forms[block].margin = 0;
                            level = by->highest * highest_level(forms, by, rows, count, first, end, memory);
                        }
                        keep_apart(to, &at, by, of, content, band, rows, first, end, n, memory);
                    }
                }
            release(memory, mark);
        }
    return limited;
}

#endif
