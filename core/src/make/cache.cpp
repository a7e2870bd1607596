// Packs leaves into OpenVDB trees.
#include "cache.h"

#include "../vdb_file.h"

#include <openvdb/tools/Prune.h>

#include <algorithm>

namespace pileus::make {

Cache::Cache(double voxel_size)
    : density_(openvdb::FloatGrid::create(0.0F)),
      velocity_(openvdb::Vec3SGrid::create(openvdb::Vec3s(0.0F))) {
    const auto transform = openvdb::math::Transform::createLinearTransform(voxel_size);
    density_->setName("density");
    density_->setGridClass(openvdb::GRID_FOG_VOLUME);
    density_->setTransform(transform);
    density_->setSaveFloatAsHalf(true);
    velocity_->setName("velocity");
    velocity_->setVectorType(openvdb::VEC_CONTRAVARIANT_RELATIVE);
    velocity_->setTransform(transform->copy());
    velocity_->setSaveFloatAsHalf(true);
}

Cache::Leaf Cache::pack(const openvdb::Coord& origin, const LeafValues& values) {
    if (std::none_of(values.density.begin(), values.density.end(),
                     [](float d) { return d >= kFaint; })) {
        return {};
    }
    Leaf leaf{std::make_unique<DensityLeaf>(origin, 0.0F, false),
              std::make_unique<VelocityLeaf>(origin, openvdb::Vec3s(0.0F), false)};
    for (int n = 0; n < kLeafVoxels; ++n) {
        const auto i = static_cast<std::size_t>(n);
        if (values.density[i] < kFaint) continue;
        const auto offset = static_cast<openvdb::Index>(n);
        leaf.density->setValueOn(offset, values.density[i]);
        leaf.velocity->setValueOn(offset, values.velocity[i]);
    }
    return leaf;
}

void Cache::insert(std::vector<Leaf>& leaves) {
    for (Leaf& leaf : leaves) {
        if (leaf.density == nullptr) continue;
        // The tree takes ownership of the leaf it is handed.
        density_->tree().addLeaf(leaf.density.release());
        velocity_->tree().addLeaf(leaf.velocity.release());
    }
}

std::int64_t Cache::write(const std::string& path, const MakeOptions& options,
                          const std::string& creator) {
    const auto active = static_cast<std::int64_t>(density_->activeVoxelCount());
    openvdb::tools::prune(density_->tree());

    openvdb::MetaMap metadata;
    metadata.insertMeta("creator", openvdb::StringMetadata(creator));
    metadata.insertMeta("frame", openvdb::Int32Metadata(options.frame));
    metadata.insertMeta("frames", openvdb::Int32Metadata(options.frames));
    metadata.insertMeta("framesPerSecond", openvdb::FloatMetadata(kFramesPerSecond));
    metadata.insertMeta("resolution", openvdb::Int32Metadata(options.resolution));
    metadata.insertMeta("seed", openvdb::Int64Metadata(static_cast<std::int64_t>(options.seed)));

    write_vdb(path, {density_, velocity_}, metadata);
    return active;
}

}  // namespace pileus::make
