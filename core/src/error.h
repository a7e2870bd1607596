// The one kind of error that is the user's to mend.
#pragma once

#include <stdexcept>

namespace pileus {

/// Wrong input. The message is one line that names the file or field, what is wrong, and the mend.
struct InputError : std::invalid_argument {
    using std::invalid_argument::invalid_argument;
};

}  // namespace pileus
