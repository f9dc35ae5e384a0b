/* An answer: its table, its question, and what is found. */
#ifndef ANSWER_H
#define ANSWER_H

#include "choice.h"
#include "harmonics.h"
#include "fingertips.h"
#include "forms.h"
#include "search.h"

/* How tones are chosen: constants of `model.answer.stimulus` and of the searches. */
typedef struct {
    int kept, missing;             /* frequencies that are ranked first, and how many of these may miss the level */
    int max_by_point, pruning_step; /* other fingers whose points count one by one; of the plates that judge first */
    int rim_count, is_deep, others; /* points of the rim; deep nulls; plates of other thickness */
    float gain_variance, ridge, margin, highest;
    float reached;
    float judged, promised;        /* percentiles of drawn plates */
    phases phases;
    method one_finger, several, within[3];
    int groups;                    /* of ERAs whose clocks are held together: a content is of one of these */
    int sets;                      /* of thresholds, the rig's own first */
    const int *rim, *group;        /* (n) of each ERA */
    const float *threshold, *error, *shares, *frequencies; /* (f); (f, n); (f, n, n) or NULL, as of `grouped`; (f) [Hz] */
    const float *sensitivities, *harmonic_sensitivities; /* (f, sets) by which amplitudes to a set's are higher, and at 2 f */
    const float *search_error, *harmonic_threshold;        /* (f, n) error and harmonics, of searches; (f) */
    const plates *at_harmonics;                            /* at twice the frequencies; NULL without harmonics */
} rules;

/* Fingers (k) and contents, as given. */
typedef struct {
    int contents, bands, fingers, quiet_count;
    int candidates, combinations; /* best tones of a content in a band; of these, those kept */
    float apart;                /* of frequencies [Hz] */
    const int *numbers;         /* (contents + 1) starts of targets; these and quiet ones, by finger; (contents)
                                 * priorities; (contents, bands, 2) first row of a band and one past the last */
    const float *level;         /* (contents) amplitude to threshold */
    const double *places;       /* (k, 2) [m] */
    const float *stiffness;     /* (f, k) of fingers */
    const float *at_harmonics;  /* the same at twice the frequencies */
    const float *load_std;      /* (k) of the logarithm of their loads */
    const float *background;    /* (f, n, n) form of the rest of the plate, for no other finger */
    const draws *judging, *promise;
} asked;

/* The same with what is found first. */
typedef struct {
    int contents, bands, quiet_count, candidates, combinations, is_ranked; /* see `ranked_rows` */
    float apart;
    const int *starts, *targets, *quiet, *priority;
    const float *level, *background;
    const draws *judging, *promise;
    distortion harmonics;
    int rows, few, fine;        /* that any band holds; points of a finger */
    int *row, *band;            /* (rows) of the table; (contents, bands, 2) of these */
    const float *few_points, *fine_points, *few_weights, *fine_weights;
} question;

/* What a caller has room for. */
typedef struct {
    int is_apart;
    int *rows;          /* (contents) of the table */
    float *figures;     /* those of `answered` in its order */
} results;

typedef struct {
    int is_apart, *rows;
    float *weights;     /* (contents, n) */
    float *gains;       /* (contents) within the stroke */
    float *contrast;    /* (k, 3) [dB] nominal, half of plates, promised, the least over the sets; NaN where there is none */
    float *level;       /* (k, 2) [dB SL] of its own content, nominal and promised */
    float *foreign;     /* (k, sets) [dB SL] of other contents, which few plates exceed */
    float *of_all;      /* worst contrast promised [dB]; least factor on levels */
} answered;

enum { FOUND, NOT_REACHED };

#endif
