// The water that the burst throws up: jets that climb, thin out, break into drops and leave mist.
// Every drop's path is a closed form in time.
#pragma once

#include "burst.h"
#include "drops.h"

#include <vector>

namespace pileus::make {

// All water in flight at the burst's time, the mist last.
std::vector<Drop> throw_spray(const Burst& burst);

}  // namespace pileus::make
