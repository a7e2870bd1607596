// A density field read from an OpenVDB file: its sampling structure and its place in the world.
#pragma once

#include "brick_tree.h"

#include <cstdint>
#include <optional>
#include <string>
#include <utility>
#include <vector>

namespace pileus {

/// Immutable once read; any number of threads may sample it.
class Volume {
  public:
    /// Reads one scalar grid of a file: by name, "" for an unnamed one, "name[n]" for the n-th
    /// (from 0) of several with one name. Level sets become fog. Throws InputError, in one line,
    /// for what cannot be a density: a missing file or grid, a vector or point grid, a frustum
    /// transform.
    Volume(const std::string& path, const std::string& grid);

    const BrickTree& tree() const { return tree_; }

    /// From the tree's local coordinates to the world, for row vectors, and back.
    const Imath::M44d& local_to_world() const { return local_to_world_; }
    const Imath::M44d& world_to_local() const { return world_to_local_; }

    /// The world box around everything stored; nothing for an empty grid.
    std::optional<std::pair<V3d, V3d>> world_bounds() const;

    const std::string& path() const { return path_; }
    const std::string& grid() const { return grid_; }
    std::int64_t active_voxels() const { return active_voxels_; }
    double load_seconds() const { return load_seconds_; }
    bool empty() const { return tree_.empty(); }
    std::size_t bytes() const { return sizeof(*this) + tree_.bytes(); }

    /// What was odd but could be decided: one line each.
    const std::vector<std::string>& warnings() const { return warnings_; }

  private:
    template <class Grid>
    void take(Grid& grid);

    std::string path_, grid_;
    BrickTree tree_;
    Imath::M44d local_to_world_, world_to_local_;
    std::int64_t active_voxels_ = 0;
    double load_seconds_ = 0.0;
    std::vector<std::string> warnings_;
};

}  // namespace pileus
