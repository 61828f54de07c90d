/* What sketches and applications include: the unit's numbers and the core, in single precision unless IMULAB_REAL is
 * defined for the whole project. */
#ifndef IMULAB_UNIT_H
#define IMULAB_UNIT_H
#ifndef IMULAB_REAL
#define IMULAB_REAL float
#endif
#include "../unit.h"
#endif
