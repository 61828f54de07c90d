/* imulab.c as Arduino, PlatformIO and Zephyr compile it; nothing where the sources themselves are in a project. */
#if defined(ARDUINO) || defined(IMULAB_UNIT_LIBRARY)
#include "imulab_unit.h"

#include "../imulab.c"
#else
typedef int imulab_core;
#endif
