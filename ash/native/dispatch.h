#pragma once
#include "kernels.h"

namespace ash {
const Kernels& kernels();  // of the instruction set in use
}
