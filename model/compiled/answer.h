/* Records of a query: rules from the table, the question, and the answer. */
#ifndef ANSWER_H
#define ANSWER_H

#include "choice.h"
#include "harmonics.h"
#include "fingertips.h"
#include "forms.h"
#include "search.h"

/* How tones are chosen: constants of `model.answer` and of the searches. Arrays are given for f frequencies and n
 * ERAs. */
typedef struct {
    int kept, missing;             /* frequencies kept by the ranking; how many of them can miss the level */
    int max_by_point, pruning_step; /* largest number of other fingers whose points count individually; step of the
                                     * draws that prune combinations */
    int rim_count, is_deep, others; /* number of rim points; whether nulls can be deep; whether plate thickness varies */
    float gain_variance, touch_offset, ridge, margin, highest; /* touch_offset: standard deviation of a finger's position
                                                                * along x and y [m] */
    float reached;
    float judged, promised;        /* percentiles of the drawn plates, for candidates and for promises */
    phases phases;
    method one_finger, several, within[3];
    int groups;                    /* groups of ERAs with synchronised clocks; one group plays a content */
    int sets;                      /* threshold sets, the rig's own first */
    const int *rim, *group;        /* fine point numbers of the rim; (n) group per ERA */
    const float *threshold, *error, *shares, *frequencies; /* (f); (f, n); (f, n, n) or NULL, see `grouped`; (f) [Hz] */
    const float *sensitivities, *harmonic_sensitivities; /* (f, sets) factors on amplitudes for each threshold set,
                                                          * and at twice the frequencies */
    const float *search_error, *harmonic_threshold;        /* (f, n) error power in searches, harmonics included; (f) */
    const plates *at_harmonics;                            /* at twice the frequencies; NULL without harmonics */
} rules;

/* The question: k fingers and their contents, as Python passes it. */
typedef struct {
    int contents, bands, fingers, quiet_count;
    int candidates, combinations; /* candidates per content and band; combinations of candidates that are kept */
    float apart;                /* minimum distance between the contents' frequencies [Hz] */
    const int *numbers;         /* (contents + 1) start of each content's targets; finger numbers of targets and of
                                 * quiet fingers; (contents) priorities; (contents, bands, 2) first row of a band and
                                 * one past the last */
    const float *level;         /* (contents) amplitude relative to the threshold */
    const double *places;       /* (k, 2) finger positions [m] */
    const float *stiffness;     /* (f, k) dynamic stiffness of the fingers */
    const float *at_harmonics;  /* the same at twice the frequencies */
    const float *load_std;      /* (k) standard deviation of the logarithm of the fingers' loads */
    const float *background;    /* (f, n, n) form of the rest of the plate, if there are no other fingers */
    const draws *judging, *promise;
} asked;

/* The question with the points under the fingertips and the rows of all bands. */
typedef struct {
    int contents, bands, quiet_count, candidates, combinations, is_ranked; /* see `ranked_rows` */
    float apart;
    const int *starts, *targets, *quiet, *priority;
    const float *level, *background;
    const draws *judging, *promise;
    distortion harmonics;
    int rows, few, fine;        /* rows in any band; coarse and fine points per finger */
    int *row, *band;            /* (rows) row numbers in the table; (contents, bands, 2) limits of bands, by index in
                                 * `row` */
    const float *few_points, *fine_points, *few_weights, *fine_weights;
    const float *touch_steps, *disc; /* (k, 3) see `steps_of`; (fine, 2) fine points in the unit disc */
} question;

/* The caller's buffers for the answer. */
typedef struct {
    int is_apart;
    int *rows;          /* (contents) row numbers in the table */
    float *figures;     /* the arrays of `answered`, in the same order */
} results;

typedef struct {
    int is_apart, *rows;
    float *weights;     /* (contents, n) */
    float *gains;       /* (contents) gain to the level, within the stroke */
    float *contrast;    /* (k, 3) [dB] nominal, median and promised, the lowest over the threshold sets; NaN without
                         * other contents */
    float *level;       /* (k, 2) [dB SL] of the finger's own content, nominal and promised */
    float *foreign;     /* (k, sets) [dB SL] of other contents: upper bound for 90 % of plates */
    float *of_all;      /* worst promised contrast [dB]; smallest factor on levels to fit the stroke */
} answered;

enum { FOUND, NOT_REACHED };

#endif
