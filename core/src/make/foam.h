// Water that stays: the churned mound over the burst and a sheet of lacing foam around it.
#pragma once

#include "burst.h"
#include "leaf.h"
#include "noise.h"

#include <openvdb/openvdb.h>

#include <array>
#include <cstddef>
#include <vector>

namespace pileus::make {

class Foam {
  public:
    // The burst must outlive the foam.
    Foam(const Burst& burst, float voxel);

    // Origins of the leaves that can hold foam.
    std::vector<openvdb::Coord> leaves() const;

    // Calls `put(voxel, density, velocity)` for each voxel of the leaf that holds foam; voxels are
    // numbers in the leaf, velocities per action second.
    template <typename Put>
    void fill(const openvdb::Coord& origin, const Put& put) const {
        for_each_block(origin, [&](const openvdb::Coord& corner) {
            if (!reaches(corner)) return;
            noise::Points at;
            for (std::size_t i = 0; i < noise::kBatch; ++i) {
                const openvdb::Vec3s p = place(voxel_of_block(corner, i), voxel_);
                at.x[i] = p.x();
                at.y[i] = p.y();
                at.z[i] = p.z();
            }
            const noise::Values density = density_at(at);
            for (std::size_t i = 0; i < noise::kBatch; ++i) {
                if (density[i] <= 0.0F) continue;
                const openvdb::Coord ijk = voxel_of_block(corner, i) - origin;
                put(number_in_leaf(ijk.x(), ijk.y(), ijk.z()), density[i],
                    burst_.mound_velocity({at.x[i], at.y[i], at.z[i]}));
            }
        });
    }

  private:
    bool reaches(const openvdb::Coord& corner) const;
    noise::Values density_at(const noise::Points& at) const;

    const Burst& burst_;
    float voxel_;
    std::vector<noise::Worley> churn_;
    std::array<noise::Worley, 2> lace_;
};

}  // namespace pileus::make
