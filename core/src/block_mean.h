// A mean over blocks of pixels, and how sure it is.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

namespace pileus {

class BlockMean {
  public:
    void add(double value) {
        sum_ += value;
        squares_ += value * value;
        ++count_;
    }

    double mean() const { return sum_ / count_; }

    /// So many standard errors above the mean: where rare bright paths make the noise, few blocks
    /// tell of it. Infinite where there is none.
    double upper(double margin) const {
        if (count_ == 0) return std::numeric_limits<double>::infinity();
        const double spread = squares_ / count_ - mean() * mean();
        return mean() + margin * std::sqrt(std::max(0.0, spread) / count_);
    }

  private:
    double sum_ = 0.0, squares_ = 0.0;
    int count_ = 0;
};

}  // namespace pileus
