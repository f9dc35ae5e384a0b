/* The kernel `answer`: chooses tones for all contents and computes their promises. Reference:
 * `model.answer.tone_search`. */
#include "candidates.h"
#include "promise.h"

/* Evaluate candidates on the drawn plates: amplitude at the weakest target (count, draws), and power at the loudest
 * point of each finger (count, k, draws). */
SHARED void judge(float *own, float *loudest, const candidates *from, const plates *on, const rules *by,
                  const question *of, const float *columns, arena *memory) {
    const draws *draws = of->judging;
    const size_t k = on->k, fine = of->fine, points = k * fine, n = on->n, count = draws->count;
    enum { BATCH = 64 };
    for (size_t first = 0; first < (size_t)from->count; first += BATCH) {
        const arena mark = *memory;
        const size_t some = from->count - first < BATCH ? from->count - first : BATCH;
        const sensors at = {.points = points, .rows = of->fine_points, .weights = of->fine_weights, .error = by->error,
                            .threshold = by->threshold, .touch_steps = of->touch_steps,
                            .disc = of->disc};
        const tones drawn = respond(on, draws, &at, columns, some, from->rows + first, from->weights + 2 * n * first, memory);
        const size_t groups = group_count(draws);
        const lanes *harmonics = find_harmonics(&of->harmonics, draws, k, some, from->rows + first,
                                                from->weights + 2 * n * first, memory);
        lanes *sensed = take(memory, points * sizeof(lanes));
        value *found = values(memory, points), *force = values(memory, on->b + k + 1);
        for (size_t tone = 0; tone < some; tone++) {
            const size_t each = first + tone, content = from->content[each];
            for (size_t group = 1; group < groups; group++) {
                size_t at_plate, plates = plates_of(draws, group, &at_plate);
                sense(sensed, &drawn, tone, group, found, force);
                lanes weakest = filled(INFINITY);
                for (int t = of->starts[content]; t < of->starts[content + 1]; t++) {
                    lanes mean = {0};
                    for (size_t i = of->targets[t] * fine; i < (of->targets[t] + 1) * fine; i++)
                        mean += of->fine_weights[i] * root(sensed[i]);
                    weakest = smaller(weakest, mean);
                }
                memcpy(own + each * count + at_plate - 1, &weakest, plates * sizeof(float));
                for (size_t finger = 0; finger < k; finger++) {
                    lanes highest = {0};
                    for (size_t i = finger * fine; i < (finger + 1) * fine; i++) highest = larger(highest, sensed[i]);
                    highest += harmonics[(tone * k + finger) * groups + group];
                    memcpy(loudest + (each * k + finger) * count + at_plate - 1, &highest, plates * sizeof(float));
                }
            }
        }
        release(memory, mark);
    }
}

/* Return the index of the best candidate of a single content: level first, then contrast. */
SHARED int best_tone(const candidates *from, const float *own, const float *loudest, const plates *on, const rules *by,
                     const question *of, arena *memory) {
    const int count = from->count, draws = of->judging->count;
    const arena mark = *memory;
    float *least = floats(memory, count), *robust = floats(memory, count), *some = floats(memory, draws);
    char *reaches = take(memory, count);
    int any = 0;
    for (int i = 0; i < count; i++) {
        memcpy(some, own + i * draws, draws * sizeof(float));
        least[i] = percentile(some, draws, by->judged);
        any |= reaches[i] = least[i] >= of->level[0] * by->reached;
    }
    for (int i = 0; i < count; i++) {
        if (of->quiet_count) {
            for (int d = 0; d < draws; d++) {
                float power = 0;
                for (int q = 0; q < of->quiet_count; q++)
                    power = fmaxf(power, loudest[(i * on->k + of->quiet[q]) * draws + d]);
                some[d] = own[i * draws + d] / fmaxf(sqrtf(power), LEAST);
            }
            robust[i] = percentile(some, draws, by->judged);
        } else {
            memcpy(some, own + i * draws, draws * sizeof(float));
            robust[i] = from->scores[i] * least[i] / percentile(some, draws, 50);
        }
        if (any && !reaches[i]) robust[i] = 0;
    }
    const int chosen_tone = best_of(robust, count);
    release(memory, mark);
    return chosen_tone;
}

/* Powers of candidates on drawn plates relative to one threshold set: at the targets (count, draws), and at the
 * loudest points of fingers (count, k, draws). */
typedef struct {
    size_t draws;
    const float *own, *loudest;
} judged;

/* Return the powers of candidates for each threshold set (sets), on every step-th drawn plate. own, loudest: from
 * `judge`, for the first threshold set. */
SHARED judged *by_sets(const float *own, const float *loudest, size_t plates, const candidates *from, size_t k, size_t step,
                       const rules *by, arena *memory) {
    const size_t draws = (plates + step - 1) / step, count = from->count, room = count * draws + LANES;
    judged *found = take(memory, by->sets * sizeof(judged));
    for (int set = 0; set < by->sets; set++) {
        float *own_power = floats(memory, room), *others_power = floats(memory, k * room);
        for (size_t i = 0; i < count; i++) {
            const float factor = by->sensitivities[from->rows[i] * by->sets + set], power = factor * factor;
            for (size_t d = 0; d < draws; d++) {
                const float amplitude = own[i * plates + d * step];
                own_power[i * draws + d] = power * amplitude * amplitude;
            }
            for (size_t j = i * k; j < (i + 1) * k; j++)
                for (size_t d = 0; d < draws; d++) others_power[j * draws + d] = power * loudest[j * plates + d * step];
        }
        found[set] = (judged){.draws = draws, .own = own_power, .loudest = others_power};
    }
    return found;
}

/* Return the power ratio at the worst finger of a combination of the first contents, on LANES plates. */
INLINE lanes least_ratio(const int *tone, size_t contents, const judged *on, size_t from, const int *content_of,
                         size_t fingers, const question *of) {
    const size_t draws = on->draws;
    lanes least = filled(INFINITY), weakest = filled(INFINITY);
    for (size_t j = 0; j < contents; j++) weakest = smaller(weakest, some(on->own + tone[j] * draws + from));
    for (size_t finger = 0; finger < fingers; finger++) {
        const int own_content = content_of[finger];
        if (own_content < 0 || (own_content < (int)contents && contents == 1)) continue;
        if (own_content >= (int)contents && own_content < of->contents) continue;
        lanes others = {0}, level = weakest;
        for (size_t j = 0; j < contents; j++)
            if ((int)j != own_content) others += some(on->loudest + (tone[j] * fingers + finger) * draws + from);
        if (own_content < (int)contents) level = some(on->own + tone[own_content] * draws + from);
        least = smaller(least, level / larger(others, filled(FAINT)));
    }
    return least;
}

/* Compute worst (count): the judged percentile of the worst power ratio of combinations (count, contents) of the first
 * contents, and of that the lowest over the threshold sets (on). Processes LANES combinations together, and keeps
 * their lowest ratios sorted. */
SHARED void worst_ratios(float *worst, const int *combinations, int count, size_t contents, const judged *on,
                         const int *content_of, size_t fingers, const rules *by, const question *of, arena *memory) {
    const size_t draws = on->draws;
    const double place = (double)by->judged / 100 * (double)(draws - 1);
    const size_t low = (size_t)place;
    const arena mark = *memory;
    lanes *lowest = take(memory, (low + 2) * sizeof(lanes));
    for (int first = 0; first < count; first += LANES) {
        lanes found = filled(INFINITY);
        for (int set = 0; set < by->sets; set++) {
            for (size_t i = 0; i < low + 2; i++) lowest[i] = filled(INFINITY);
            for (size_t from = 0; from < draws; from += LANES) {
                lanes ratios[LANES];
                for (int l = 0; l < LANES; l++) {
                    const size_t each = first + l < count ? first + l : count - 1;
                    ratios[l] = least_ratio(combinations + each * of->contents, contents, on + set, from, content_of, fingers, of);
                }
                transpose(ratios);
                for (size_t d = 0; d < LANES && from + d < draws; d++)
                    for (size_t i = 0; i < low + 2; i++) {
                        const lanes below = smaller(lowest[i], ratios[d]);
                        ratios[d] = larger(lowest[i], ratios[d]), lowest[i] = below;
                    }
            }
            found = smaller(found, lowest[low] + filled((float)(place - (double)low)) * (lowest[low + 1] - lowest[low]));
        }
        for (int l = 0; l < LANES && first + l < count; l++) worst[first + l] = found[l];
    }
    release(memory, mark);
}

/* Choose a candidate for each content. Combinations with separate frequencies come first, others only without any.
 * Return whether the frequencies are separate, or -1 without a combination. */
SHARED int best_combination(int *chosen_tones, const candidates *from, const float *own, const float *loudest,
                            const plates *on, const rules *by, const question *of, arena *memory) {
    const int contents = of->contents, most = of->combinations;
    const size_t each = (size_t)of->bands * by->groups * 2 * of->candidates; /* largest number of candidates of a
                                                                              * content */
    const size_t room = each > (size_t)most ? each : (size_t)most;
    const arena mark = *memory;
    int *content_of = integers(memory, on->k), *kept = integers(memory, room * contents);
    for (int i = 0; i < on->k; i++) content_of[i] = -1;
    for (int i = 0; i < of->quiet_count; i++) content_of[of->quiet[i]] = contents;
    for (int j = 0; j < contents; j++)
        for (int t = of->starts[j]; t < of->starts[j + 1]; t++) content_of[of->targets[t]] = j;
    int *tried = integers(memory, room * each * contents), *order = integers(memory, room * each);
    float *worst = floats(memory, room * each);
    const size_t plates = of->judging->count;
    const judged *few = by_sets(own, loudest, plates, from, on->k, by->pruning_step, by, memory);
    const judged *every = by_sets(own, loudest, plates, from, on->k, 1, by, memory);
    for (int pass = 0; pass < 2; pass++) {
        const float gap = pass ? 0 : of->apart - SAME_FREQUENCY;
        int count = 1, found = 0;
        for (int j = 0; j < contents && count; j++) {
            found = 0;
            for (int before = 0; before < count; before++)
                for (int tone = 0; tone < from->count; tone++) {
                    int allowed = from->content[tone] == j;
                    for (int other = 0; allowed && other < j; other++) {
                        const int at = kept[before * contents + other];
                        allowed &= fabsf(by->frequencies[from->rows[tone]] - by->frequencies[from->rows[at]]) >= gap;
                        allowed &= of->bands == 1 || from->band[tone] != from->band[at];
                    }
                    if (!allowed) continue;
                    memcpy(tried + (size_t)found * contents, kept + before * contents, j * sizeof(int));
                    tried[(size_t)found++ * contents + j] = tone;
                }
            count = found;
            if (j && count > most) { /* a single content has no ratio to others */
                worst_ratios(worst, tried, count, j + 1, few, content_of, on->k, by, of, memory);
                best_first(order, worst, count, memory);
                count = most;
            } else
                for (int i = 0; i < count; i++) order[i] = i;
            for (int i = 0; i < count; i++)
                memcpy(kept + i * contents, tried + (size_t)order[i] * contents, contents * sizeof(int));
        }
        if (!count) continue;
        worst_ratios(worst, kept, count, contents, every, content_of, on->k, by, of, memory);
        memcpy(chosen_tones, kept + best_of(worst, count) * contents, contents * sizeof(int));
        release(memory, mark);
        return !pass;
    }
    release(memory, mark);
    return -1;
}

/* Scale each candidate to its content's level on the judged share of drawn plates. */
INLINE void bring_to_level(float *own, float *loudest, const candidates *from, size_t k, const rules *by,
                           const question *of, arena *memory) {
    const size_t draws = of->judging->count;
    const arena mark = *memory;
    float *some = floats(memory, draws);
    for (int i = 0; i < from->count; i++) {
        memcpy(some, own + i * draws, draws * sizeof(float));
        float gain = of->level[from->content[i]] / fmaxf(percentile(some, draws, by->judged), FAINT);
        for (size_t d = 0; d < draws; d++) own[i * draws + d] *= gain;
        for (size_t d = 0; d < k * draws; d++) loudest[i * k * draws + d] *= gain * gain;
    }
    release(memory, mark);
}

static int answer_from(answered *to, const plates *on, const rules *by, const question *of, arena *memory) {
    const size_t n = on->n, k = on->k, contents = of->contents;
    const int *rows = of->row;
    int count = of->rows, *some = integers(memory, count), *best_tones = integers(memory, contents);
    if (of->is_ranked) {
        const int kept = ranked_rows(some, on, by, of, memory);
        if (kept && kept < count) rows = some, count = kept;
    }
    const size_t most = contents * of->bands * by->groups * 2 * of->candidates;
    candidates from = {.content = integers(memory, most), .band = integers(memory, most),
                       .rows = integers(memory, most), .scores = floats(memory, most),
                       .weights = floats(memory, 2 * most * n)};
    int is_limited = find_candidates(&from, on, by, of, rows, count, memory);
    if (count < of->rows && (!from.count || is_limited) && of->is_ranked) {
        from.count = 0; /* search all frequencies */
        is_limited = find_candidates(&from, on, by, of, of->row, of->rows, memory);
    }
    if (!from.count) return NOT_REACHED;
    const float *columns = columns_of(of->fine_points, k * of->fine, on, memory);
    const size_t draws = of->judging->count;
    float *own = floats(memory, from.count * draws + LANES);
    float *loudest = floats(memory, from.count * k * draws + LANES);
    best_tones[0] = 0, to->is_apart = 1;
    if (from.count > 1) judge(own, loudest, &from, on, by, of, columns, memory);
    if (contents == 1 && from.count > 1) best_tones[0] = best_tone(&from, own, loudest, on, by, of, memory);
    if (contents > 1) {
        bring_to_level(own, loudest, &from, k, by, of, memory);
        to->is_apart = best_combination(best_tones, &from, own, loudest, on, by, of, memory);
        if (to->is_apart < 0) return NOT_REACHED;
    }
    for (size_t j = 0; j < contents; j++) {
        to->rows[j] = from.rows[best_tones[j]];
        memcpy(to->weights + 2 * n * j, from.weights + 2 * n * best_tones[j], 2 * n * sizeof(float));
    }
    promise(to, on, by, of, columns, memory);
    return FOUND;
}

/* List the rows in any band, and convert the limits of bands to indices in this list. */
SHARED void find_rows(question *of, const int *bands, arena *memory) {
    const int ends = of->contents * of->bands * 2;
    int most = 0;
    for (int i = 1; i < ends; i += 2) most = bands[i] > most ? bands[i] : most;
    int *before = integers(memory, most + 1);
    of->row = integers(memory, most), of->band = integers(memory, ends);
    for (int at = 0; at < most; at++) {
        int is_held = 0;
        for (int i = 0; i < ends; i += 2) is_held |= bands[i] <= at && at < bands[i + 1];
        before[at] = of->rows;
        if (is_held) of->row[of->rows++] = at;
    }
    before[most] = of->rows;
    for (int i = 0; i < ends; i++) of->band[i] = before[bands[i]];
}

static int guarded(results *found, const plates *table, const raster *read, const rules *by, const asked *given,
                   arena *memory) {
    jmp_buf failed;
    memory->failed = &failed;
    if (setjmp(failed)) return NO_MEMORY;
    const size_t contents = given->contents, k = given->fingers;
    const tips at = read_tips(read, given->places, k, memory);
    plates on = *table;
    on.k = given->fingers, on.centers = at.centers, on.stiffness = given->stiffness, on.load_std = given->load_std;
    question of = {.contents = given->contents, .bands = given->bands, .quiet_count = given->quiet_count,
                   .candidates = given->candidates, .combinations = given->combinations, .apart = given->apart,
                   .level = given->level, .background = given->background, .judging = given->judging,
                   .promise = given->promise, .few = read->few, .fine = read->fine, .few_points = at.few,
                   .fine_points = at.fine, .few_weights = at.few_weights, .fine_weights = at.fine_weights};
    of.starts = given->numbers, of.targets = of.starts + contents + 1, of.quiet = of.targets + of.starts[contents];
    of.priority = of.quiet + of.quiet_count;
    of.is_ranked = contents == 1 && of.starts[1] == 1 && of.bands == 1 && of.quiet_count > 0 && by->groups == 1;
    of.disc = read->points + 2 * read->few;
    of.touch_steps = steps_of(read, given->places, k, by->touch_offset, memory);
    find_rows(&of, of.priority + contents, memory);
    plates twice;
    if (by->at_harmonics) {
        twice = *by->at_harmonics;
        twice.k = given->fingers, twice.centers = at.centers, twice.stiffness = given->at_harmonics;
        twice.load_std = given->load_std;
        of.harmonics = (distortion){.on = &twice, .threshold = by->harmonic_threshold, .points = at.few,
                                    .weights = at.few_weights, .few = read->few};
    }
    answered to = {.rows = found->rows, .weights = found->figures};
    to.gains = to.weights + 2 * contents * on.n, to.contrast = to.gains + contents, to.level = to.contrast + 3 * k;
    to.foreign = to.level + 2 * k, to.of_all = to.foreign + k * by->sets;
    const int status = answer_from(&to, &on, by, &of, memory);
    found->is_apart = to.is_apart;
    return status;
}

/* Return FOUND, NOT_REACHED if no tone can be felt, or NO_MEMORY. */
int answer(results *to, const plates *on, const raster *read, const rules *by, const asked *of) {
    arena memory = {.last = NULL};
    const int status = guarded(to, on, read, by, of, &memory);
    release(&memory, (arena){.last = NULL});
    return status;
}
