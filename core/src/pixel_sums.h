// What a pixel's samples come to: means, variances of the means, and each order's share.
#pragma once

#include "partial.h"
#include "path.h"

#include <algorithm>
#include <vector>

namespace pileus {

/// Sums over one pixel's samples.
class PixelSums {
  public:
    PixelSums(std::size_t looks, std::size_t orders, bool keep_orders)
        : keep_orders_(keep_orders),
          sum_(looks, V3d(0.0)),
          squares_(looks, V3d(0.0)),
          order_sums_(keep_orders ? looks * orders : 0, V3d(0.0)) {}

    void clear() {
        std::fill(sum_.begin(), sum_.end(), V3d(0.0));
        std::fill(squares_.begin(), squares_.end(), V3d(0.0));
        std::fill(order_sums_.begin(), order_sums_.end(), V3d(0.0));
        opacity_ = depth_ = 0.0;
    }

    void add(const PathRecord& record) {
        for (std::size_t look = 0; look < sum_.size(); ++look) {
            V3d radiance(record.sky);
            for (std::size_t i = 0; i < record.orders(); ++i) {
                const V3d layer(record.radiance(look, i));
                radiance += layer;
                if (keep_orders_) order_sums_[look * record.orders() + i] += layer;
            }
            sum_[look] += radiance;
            squares_[look] += radiance * radiance;
        }
        opacity_ += record.opacity;
        depth_ += record.opacity * record.depth;
    }

    void store(LayeredImage& image, std::size_t pixel, int count) const {
        const double n = count;
        for (std::size_t look = 0; look < sum_.size(); ++look) {
            const auto set = [&](std::size_t channel, double value) {
                image.plane(look, channel)[pixel] = storable(value);
            };
            for (int c = 0; c < 3; ++c) {
                const auto channel = static_cast<std::size_t>(c);
                const double mean = sum_[look][c] / n;
                set(Partial::r + channel, mean);
                const double spread = std::max(0.0, squares_[look][c] - mean * sum_[look][c]);
                set(Partial::variance_r + channel, count > 1 ? spread / (n * (n - 1.0)) : 0.0);
            }
            set(Partial::a, opacity_ / n);
            set(Partial::z, opacity_ > 0.0 ? depth_ / opacity_ : 0.0);
            const std::size_t orders = order_sums_.size() / sum_.size();
            for (std::size_t i = 0; i < orders; ++i) {
                for (int c = 0; c < 3; ++c) {
                    set(Partial::first_order + 3 * i + static_cast<std::size_t>(c),
                        order_sums_[look * orders + i][c] / n);
                }
            }
        }
    }

  private:
    bool keep_orders_;
    std::vector<V3d> sum_, squares_, order_sums_;
    double opacity_ = 0.0, depth_ = 0.0;
};

}  // namespace pileus
