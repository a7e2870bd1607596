// The tiles into which the buckets of many tasks are cut, for threads to take one after another.
#pragma once

#include "render.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <optional>
#include <span>
#include <vector>

namespace pileus {

/// Pixels of one task's bucket.
struct Tile {
    std::size_t task;
    Bucket area;
};

class Tiles {
  public:
    /// The tasks must outlive them.
    explicit Tiles(std::span<const RenderTask> tasks) : tasks_(tasks) {
        std::size_t end = 0;
        for (const RenderTask& task : tasks) {
            const int side = std::clamp(
                static_cast<int>(std::sqrt(double{samples} / task.samples.count())), 1, 32);
            const auto tiles = [&](int pixels) { return (pixels + side - 1) / side; };
            const int columns = tiles(task.bucket.width());
            end += static_cast<std::size_t>(columns) *
                   static_cast<std::size_t>(tiles(task.bucket.height()));
            grids_.push_back({side, columns, end});
        }
    }

    std::size_t count() const { return grids_.empty() ? 0 : grids_.back().end; }

    /// A tile that no other thread has, until there are none.
    std::optional<Tile> take() {
        const std::size_t number = next_.fetch_add(1, std::memory_order_relaxed);
        const auto grid = std::upper_bound(grids_.begin(), grids_.end(), number,
                                           [](std::size_t n, const Grid& g) { return n < g.end; });
        if (grid == grids_.end()) return std::nullopt;
        const auto task = static_cast<std::size_t>(grid - grids_.begin());
        const auto here =
            static_cast<int>(number - (grid == grids_.begin() ? 0 : std::prev(grid)->end));
        const Bucket& b = tasks_[task].bucket;
        const int x = b.x0 + here % grid->columns * grid->side;
        const int y = b.y0 + here / grid->columns * grid->side;
        return Tile{task, {x, y, std::min(x + grid->side, b.x1), std::min(y + grid->side, b.y1)}};
    }

  private:
    // Samples in a tile, if its pixels have no more: so few that threads end together.
    static constexpr int samples = 1024;

    struct Grid {
        int side, columns;  // of a tile, in pixels; of the bucket, in tiles
        std::size_t end;    // the tiles up to here, those of earlier tasks included
    };

    std::span<const RenderTask> tasks_;
    std::vector<Grid> grids_;
    std::atomic<std::size_t> next_{0};
};

}  // namespace pileus
