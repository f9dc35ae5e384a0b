/* Shapes of the plate under fingertips. Reference: `model.table.table` and `model.finger`. */
#ifndef FINGERTIPS_H
#define FINGERTIPS_H

#include "arena.h"

typedef struct {
    int nx, ny, side_x, side_y, r; /* points of the raster; points of an interpolated patch; reduced coordinates */
    int few, fine;                 /* points per fingertip: coarse and fine rule */
    double length, width, radius;  /* size of the plate, radius of a fingertip [m] */
    const float *points, *weights; /* (few + fine, 2) in the unit disc, coarse rule first; (2, few + fine) */
    const float *nodes;            /* (8, 2) Gauss-Legendre points and weights */
    const float *shapes;           /* (ny nx, r) */
} raster;

typedef struct {
    float *few, *fine, *few_weights, *fine_weights, *centers; /* (k, few, r), (k, fine, r), (k, few), (k, fine), (k, r) */
} tips;

/* Low and high ends of the disc along x and y, by number among the coarse and the fine points. */
static const int FEW_ENDS[2][2] = {{3, 1}, {4, 2}}, FINE_ENDS[2][2] = {{15, 9}, {18, 12}};

/* Fine points at (+-1/2, +-1/2), by quadrant. */
static const int FINE_DIAGONAL[4] = {2, 4, 6, 8};

/* Return (k, 3): standard deviation `offset` [m] of each finger's position along x and y, as a fraction of the distance
 * between both ends of the disc, and 1 for a disc that no edge cuts, else 0. NULL for exact positions. */
SHARED float *steps_of(const raster *on, const double *places, size_t k, float offset, arena *memory) {
    if (offset == 0) return NULL;
    float *steps = floats(memory, 3 * k);
    for (size_t finger = 0; finger < k; finger++) {
        const double sides[2] = {on->length, on->width};
        steps[3 * finger + 2] = 1;
        for (int axis = 0; axis < 2; axis++) {
            const double at = places[2 * finger + axis], low = at - on->radius, high = at + on->radius;
            steps[3 * finger + axis] = offset / (float)(fmin(high, sides[axis]) - fmax(low, 0));
            if (low <= 0 || high >= sides[axis]) steps[3 * finger + 2] = 0;
        }
    }
    return steps;
}

INLINE double within(double a, double low, double high) { return a < low ? low : a > high ? high : a; }

/* Compute the centroid of the part of the unit disc inside a rectangle that contains its center. */
SHARED void centroid_of(double *to, const double *low, const double *high, const raster *on) {
    const double bottom = fmax(low[1], -1), top = fmin(high[1], 1);
    const double first = asin(fmax(low[0], -1)), last = asin(fmin(high[0], 1));
    const double corners[2] = {acos(-bottom), acos(top)};
    double ends[6] = {first, -corners[0], corners[0], -corners[1], corners[1], last}, area = 0;
    to[0] = to[1] = 0;
    for (int i = 0; i < 6; i++) {
        double own = within(ends[i], first, last);
        int at = i;
        for (; at > 0 && ends[at - 1] > own; at--) ends[at] = ends[at - 1];
        ends[at] = own;
    }
    for (int i = 0; i < 5; i++)
        for (int node = 0; node < 8; node++) {
            const double half = (ends[i + 1] - ends[i]) / 2, angle = ends[i] + half + half * on->nodes[2 * node];
            const double x = sin(angle), rim = cos(angle), width = half * on->nodes[2 * node + 1] * rim;
            const double from = fmax(-rim, bottom), till = fmin(rim, top);
            area += width * (till - from);
            to[0] += width * x * (till - from), to[1] += width * (till * till - from * from) / 2;
        }
    to[0] /= area, to[1] /= area;
}

/* Refit the weights (points) of the kept points: multiply them by a linear function so that means of linear functions
 * are exact, and raise negative weights to 0. */
SHARED void refit(double *weights, const char *is_kept, const double *centroid, const raster *on) {
    const int count = on->few + on->fine;
    double sum = 0, A[3][4] = {{1e-9, 0, 0, 1}, {0, 1e-9, 0, centroid[0]}, {0, 0, 1e-9, centroid[1]}};
    for (int i = 0; i < count; i++) sum += weights[i] *= is_kept[i];
    for (int i = 0; i < count; i++) {
        const double each[3] = {1, on->points[2 * i], on->points[2 * i + 1]};
        weights[i] /= sum;
        for (int u = 0; u < 3; u++)
            for (int v = 0; v < 3; v++) A[u][v] += weights[i] * each[u] * each[v];
    }
    for (int s = 0; s < 3; s++) /* positive definite, so no pivoting */
        for (int u = 0; u < 3; u++)
            for (int v = 3; u != s && v >= s; v--) A[u][v] -= A[u][s] / A[s][s] * A[s][v];
    sum = 0;
    for (int i = 0; i < count; i++) {
        const double x = on->points[2 * i], y = on->points[2 * i + 1];
        weights[i] = fmax(weights[i] * (A[0][3] / A[0][0] + A[1][3] / A[1][1] * x + A[2][3] / A[2][2] * y), 0);
        sum += weights[i];
    }
    for (int i = 0; i < count; i++) weights[i] /= sum;
}

/* Compute the Lagrange polynomials of the nodes 0, 1, ..., count - 1 at x. */
INLINE void lagrange(float *to, double x, int count) {
    for (int i = 0; i < count; i++) {
        double found = 1;
        for (int j = 0; j < count; j++)
            if (j != i) found *= (x - j) / (i - j);
        to[i] = (float)found;
    }
}

/* Return the shapes under fingertips centered at places (k, 2) [m], and the weights of their points in the mean over a
 * fingertip. */
SHARED tips read_tips(const raster *on, const double *places, size_t k, arena *memory) {
    const size_t r = on->r, few = on->few, fine = on->fine, count = few + fine, patch = on->side_x * on->side_y;
    const size_t half = patch / 2, padded = (r + LANES - 1) / LANES * LANES;
    tips to = {.few = floats(memory, k * few * r), .fine = floats(memory, k * fine * r),
               .few_weights = floats(memory, k * few), .fine_weights = floats(memory, k * fine),
               .centers = floats(memory, k * r)};
    const arena mark = *memory;
    float *near = floats(memory, patch * padded), *share = floats(memory, patch), *found = floats(memory, padded);
    float *along_x = floats(memory, on->side_x), *along_y = floats(memory, on->side_y);
    double *weights = take(memory, 2 * count * sizeof(double)), *inside = take(memory, 2 * count * sizeof(double));
    char *is_kept = take(memory, count);
    memset(near, 0, patch * padded * sizeof(float));
    for (size_t finger = 0; finger < k; finger++) {
        const double *center = places + 2 * finger, size[2] = {on->length, on->width};
        const int points[2] = {on->nx, on->ny}, side[2] = {on->side_x, on->side_y};
        double low[2], high[2], spacing[2];
        int start[2], is_cut = 0;
        for (int axis = 0; axis < 2; axis++) {
            low[axis] = -center[axis] / on->radius, high[axis] = (size[axis] - center[axis]) / on->radius;
            spacing[axis] = size[axis] / (points[axis] - 1);
            start[axis] = (int)within(rint(center[axis] / spacing[axis] - (side[axis] - 1) / 2.0), 0, points[axis] - side[axis]);
        }
        for (size_t i = 0; i < count; i++) {
            for (int axis = 0; axis < 2; axis++) inside[2 * i + axis] = within(on->points[2 * i + axis], low[axis], high[axis]);
            is_kept[i] = inside[2 * i] == on->points[2 * i] && inside[2 * i + 1] == on->points[2 * i + 1];
            is_cut |= !is_kept[i];
        }
        for (size_t i = 0; i < 2 * count; i++) weights[i] = on->weights[i];
        if (is_cut) {
            double centroid[2];
            centroid_of(centroid, low, high, on);
            refit(weights, is_kept, centroid, on), refit(weights + count, is_kept, centroid, on);
        }
        for (size_t i = 0; i < few; i++) to.few_weights[finger * few + i] = (float)weights[i];
        for (size_t i = 0; i < fine; i++) to.fine_weights[finger * fine + i] = (float)weights[count + few + i];

        for (size_t y = 0; y < (size_t)side[1]; y++)
            for (size_t x = 0; x < (size_t)side[0]; x++)
                memcpy(near + (y * side[0] + x) * padded, on->shapes + ((start[1] + y) * on->nx + start[0] + x) * r,
                       r * sizeof(float));
        for (size_t i = 0; i < count; i++) {
            lagrange(along_x, (center[0] + on->radius * inside[2 * i]) / spacing[0] - start[0], side[0]);
            lagrange(along_y, (center[1] + on->radius * inside[2 * i + 1]) / spacing[1] - start[1], side[1]);
            for (int y = 0; y < side[1]; y++)
                for (int x = 0; x < side[0]; x++) share[y * side[0] + x] = along_y[y] * along_x[x];
            for (size_t at = 0; at < padded; at += LANES) {
                lanes first = {0}, second = {0}, from;
                for (size_t j = 0; j < patch - half; j++) { /* halves instead of even and odd points, which have
                                                             * opposite signs and would cancel */
                    memcpy(&from, near + (half + j) * padded + at, sizeof from);
                    second += share[half + j] * from;
                    if (j == half) break;
                    memcpy(&from, near + j * padded + at, sizeof from);
                    first += share[j] * from;
                }
                first += second;
                memcpy(found + at, &first, sizeof first);
            }
            memcpy(i < few ? to.few + (finger * few + i) * r : to.fine + (finger * fine + i - few) * r, found,
                   r * sizeof(float));
        }
        memcpy(to.centers + finger * r, to.few + finger * few * r, r * sizeof(float));
    }
    release(memory, mark);
    return to;
}

#endif
