#include "path.h"

#include "tracking.h"

#include <cmath>

namespace pileus {

namespace {

/// Directions towards the sky for every look at once: the medium's own lobe at the first order,
/// where all looks share it, and an even mixture with the sphere after it, where c^i g lies
/// anywhere in between.
class Lobe {
  public:
    Lobe(const HenyeyGreenstein& phase, bool mixed) : phase_(phase), mixed_(mixed) {}

    V3f sample(const V3f& in, Random& random) const {
        const bool sphere = mixed_ && random.uniform() < 0.5f;
        const float u1 = random.uniform(), u2 = random.uniform();
        return sphere ? HenyeyGreenstein(0.0f).sample(in, u1, u2) : phase_.sample(in, u1, u2);
    }

    float density(const V3f& in, const V3f& out) const {
        const float lobe = phase_.density(in, out);
        return mixed_ ? 0.5f * (lobe + 0.25f / pi) : lobe;
    }

  private:
    const HenyeyGreenstein& phase_;
    bool mixed_;
};

}  // namespace

DirectLight::DirectLight(const Scene& scene, const std::vector<Look>& looks, Sky sky)
    : scene_(scene), looks_(looks), sky_(sky) {}

void DirectLight::set_terms(int first, int last) {
    if (first == first_ && last == last_) return;
    first_ = first;
    last_ = last;
    terms_.clear();
    powers_.clear();
    for (std::size_t k = 0; k < looks_.size(); ++k) {
        for (int i = first; i < last; ++i) {
            const Look& look = looks_[k];
            const auto power = [i](float base) { return std::pow(base, static_cast<float>(i)); };
            terms_.push_back({k, i, power(look.b),
                              HenyeyGreenstein(power(look.c) * scene_.medium.phase().g()),
                              sky_ == Sky::walk && look.physical()});
            powers_.push_back(power(look.a));
        }
    }
    transmittances_.resize(powers_.size());
}

void DirectLight::shadow(const ScatterEvent& event, const V3f& direction, Random& random) {
    ratio_track(scene_.medium, scene_.medium.ray(event.position, direction), random, powers_,
                transmittances_);
}

void DirectLight::add(const ScatterEvent& event, int first, int last, const PathRandom& random,
                      PathRecord& record) {
    set_terms(first, last);
    const HenyeyGreenstein& phase = scene_.medium.phase();
    const Lobe lobe(phase, last > 1);
    bool all_walk = true;
    for (const Term& term : terms_) all_walk &= term.walk;

    for (std::size_t l = 0; l < scene_.lights.size(); ++l) {
        const Light& light = *scene_.lights[l];
        const auto order = static_cast<std::uint64_t>(first);
        // The light's own directions ...
        Random stream = random.stream(light_stream, order, l);
        const float u1 = stream.uniform(), u2 = stream.uniform();
        if (const auto sample = light.sample(u1, u2)) {
            shadow(event, sample->direction, stream);
            const float lobe_density =
                light.can_be_hit() ? lobe.density(event.direction, sample->direction) : 0.0f;
            const float walk_density =
                light.can_be_hit() ? phase.density(event.direction, sample->direction) : 0.0f;
            for (std::size_t k = 0; k < terms_.size(); ++k) {
                if (transmittances_[k] == 0.0f) continue;
                const Term& term = terms_[k];
                const float rival = term.walk ? walk_density : lobe_density;
                const float share =
                    rival > 0.0f ? sample->density / (sample->density + rival) : 1.0f;
                record.add(term.look, term.order,
                           event.weight * sample->radiance *
                               (share * term.weight * transmittances_[k] *
                                term.phase.density(event.direction, sample->direction)));
            }
        }
        // ... and the phase function's, weighed against each other by the balance heuristic (Veach
        // 1997).
        if (!light.can_be_hit() || all_walk) continue;
        Random lobe_random = random.stream(lobe_stream, order, l);
        const V3f direction = lobe.sample(event.direction, lobe_random);
        const float density = lobe.density(event.direction, direction) + light.density(direction);
        const Color radiance = light.radiance(direction);
        if (!(density > 0.0f) || radiance == Color(0.0f)) continue;
        shadow(event, direction, lobe_random);
        for (std::size_t k = 0; k < terms_.size(); ++k) {
            const Term& term = terms_[k];
            if (term.walk || transmittances_[k] == 0.0f) continue;
            record.add(term.look, term.order,
                       event.weight * radiance *
                           (term.weight * transmittances_[k] *
                            term.phase.density(event.direction, direction) / density));
        }
    }
}

void DirectLight::add_escape(const ScatterEvent& event, const V3f& direction, int order,
                             PathRecord& record) const {
    if (sky_ != Sky::walk) return;
    const float density = scene_.medium.phase().density(event.direction, direction);
    for (const auto& light : scene_.lights) {
        if (!light->can_be_hit()) continue;
        const float share = density / (density + light->density(direction));
        const Color radiance = event.weight * light->radiance(direction) * share;
        for (std::size_t k = 0; k < looks_.size(); ++k) {
            if (looks_[k].physical()) record.add(k, order, radiance);
        }
    }
}

}  // namespace pileus
