/* An answer: its table, its question, and what is found. */
#ifndef ANSWER_H
#define ANSWER_H

#include "choice.h"
#include "drawn.h"
#include "forms.h"
#include "search.h"

/* How tones are chosen: constants of `model.table.contents` and of the searches. */
typedef struct {
    int kept, missing;             /* frequencies that are ranked first, and how many of these may miss the level */
    int max_by_point, candidates;  /* other fingers whose points count one by one; best tones of a content */
    int max_combinations, pruning_step;
    int rim_count, is_deep, others, times; /* points of the rim; deep nulls; plates of other thickness; of an onset */
    float gain_variance, ridge, margin, highest;
    float reached, onset_margin, onset_weight;
    float judged, promised;        /* percentiles of drawn plates */
    phases phases;
    method one_finger, several, within[3];
    const int *rim;
    const float *threshold, *error, *frequencies; /* (f); (f, n); (f) [Hz] */
    const float *onsets;           /* (f, n, times, r), or none */
} rules;

typedef struct {
    int contents, bands, rows, quiet_count, few, fine; /* few, fine: points of a finger */
    int is_ranked, is_strict, with_onset; /* strict: give up where the level is hard to reach */
    float apart;                          /* of frequencies [Hz] */
    const int *row, *starts, *targets, *quiet; /* (rows); (contents + 1) of the targets; fingers; fingers */
    const int *priority, *band;           /* (contents); (contents, bands, 2) first row and one past the last */
    const float *level;                   /* (contents) amplitude to threshold */
    const float *few_points, *fine_points, *few_weights, *fine_weights;
    const float *background;              /* (f, n, n) form of the rest of the plate, for no other finger */
    const draws *judging, *promise;
} question;

typedef struct {
    int is_apart, is_limited;
    int *rows;          /* (contents) of the table */
    float *weights;     /* (contents, n) */
    float *gains;       /* (contents) within the stroke */
    float *contrast;    /* (k, 3) as modelled, half of plates, promised; NaN where there is none */
    float *level;       /* (k, 2) of its own content, as modelled and promised */
    float *foreign;     /* (k) of other contents, which few plates exceed */
    float *of_all;      /* worst contrast promised; least factor on requested levels; loudest at quiet fingers */
} answered;

enum { FOUND, NOT_REACHED, NEEDS_ONSETS };

#endif
