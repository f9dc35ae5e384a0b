// SPDX-License-Identifier: MIT

#include "config.h"

struct sound_format sound_format;
