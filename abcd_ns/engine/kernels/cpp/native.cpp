// All that is hot on a CPU, with a C interface: kernels/native.py compiles it once a machine and loads it.
#include "lanes.h"
//
#include "adam.h"
#include "between.h"
#include "drawing.h"
#include "photometric.h"
#include "projection.h"
#include "threads.h"
#include "worth.h"

extern "C" void abcd_threads(int count) { threads_in_use = count; }
