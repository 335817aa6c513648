#pragma once
#include "views/arena.h"
