// A volume as light meets it: extinction, albedo and phase function over a density field. Every
// medium answers two questions, the extinction at a point and the majorants along a ray (the
// arrangement of pbrt-v4's media, Pharr, Jakob & Humphreys 2023). The march asks them; the lanes of
// tracker_lanes.inc find the same many at once.
#pragma once

#include "majorants.h"
#include "phase.h"
#include "volume.h"

#include <algorithm>

namespace pileus {

class Medium {
  public:
    /// `extinction` is sigma_t at density 1, per world unit. The volume must outlive the medium.
    Medium(const Volume& volume, float extinction, const Color& albedo, float anisotropy)
        : tree_(&volume.tree()), extinction_(extinction), albedo_(albedo), phase_(anisotropy) {
        const Imath::M44d& m = volume.world_to_local();
        for (int row = 0; row < 3; ++row) {
            for (int column = 0; column < 3; ++column) {
                to_local_[row][column] = static_cast<float>(m[row][column]);
            }
            const V3d voxels(m[row][0], m[row][1], m[row][2]);  // along one unit of the world
            thickest_ = std::max(thickest_, 1000.0f * static_cast<float>(voxels.length()));
            longest_ = std::max(longest_, 1.0f / static_cast<float>(voxels.length()));
        }
    }

    /// The medium that scatters alike with another anisotropy, by the similarity relation
    /// sigma_s (1 - g) = const with sigma_a kept, of the channel that absorbs least; the others'
    /// albedos are those that keep their sigma_a.
    Medium reduced(float anisotropy) const {
        const float albedo = max_component(albedo_);
        const float ratio = 1.0f - albedo + albedo * (1.0f - phase_.g()) / (1.0f - anisotropy);
        Medium result = *this;
        result.extinction_ *= ratio;
        result.thickest_ *= ratio;
        for (int c = 0; c < 3; ++c) {
            result.albedo_[c] = std::max(0.0f, 1.0f - (1.0f - albedo_[c]) / ratio);
        }
        result.phase_ = HenyeyGreenstein(anisotropy);
        return result;
    }

    const Color& albedo() const { return albedo_; }
    const HenyeyGreenstein& phase() const { return phase_; }

    /// Of directions of the world, as row vectors.
    const Imath::M33f& to_local() const { return to_local_; }

    /// A ray from a local position along a unit vector of the world.
    LocalRay ray(const V3f& local_position, const V3f& world_direction) const {
        return {local_position, world_direction * to_local_};
    }

    /// sigma_t at a local position inside the box: one interpolated voxel.
    float extinction(const V3f& x) const { return bounded(tree_->interpolate(x)); }
    float extinction(const V3f& x, BrickTree::Cursor& cursor) const {
        return bounded(tree_->interpolate(x, cursor));
    }

    /// The stretches of a ray that may hold anything, with majorants of the density.
    MajorantIterator majorants(const LocalRay& ray) const { return {*tree_, ray}; }

    /// What `bounded` reads: sigma_t at density 1, and the most that it may be.
    float coefficient() const { return extinction_; }
    float thickest() const { return thickest_; }

    /// The majorant of sigma_t where that of the density is given.
    float majorant(float density) const { return bounded(density); }

    /// The boxes that are worth being told apart along a ray: of a fine or thin volume's bricks
    /// most are crossed without a collision.
    Boxes boxes() const {
        const float thickness = majorant(tree_->max()) * longest_ * BrickTree::width;
        return thickness < 1.5f ? Boxes::eights : Boxes::bricks;
    }

  private:
    /// sigma_t of a density. A thousand mean free paths a voxel are as good as any more, and keep
    /// the work along a ray, and its steps in float, bounded.
    float bounded(float density) const { return std::min(extinction_ * density, thickest_); }

    const BrickTree* tree_;
    float extinction_;
    float thickest_ = 0.0f;
    float longest_ = 0.0f;  // a voxel's longest side, world units
    Color albedo_;
    HenyeyGreenstein phase_;
    Imath::M33f to_local_;
};

}  // namespace pileus
