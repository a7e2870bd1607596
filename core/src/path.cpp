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

    V3f sample(const V3f& in, float choice, float u1, float u2) const {
        const bool sphere = mixed_ && choice < 0.5f;
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

/// The way from an event to a light, for one power of its transmittance after the other. Each power
/// starts from the same random numbers, so a look does not notice the others.
class Shadow {
  public:
    Shadow(const Medium& medium, const V3f& position, const V3f& direction, const Random& random)
        : medium_(medium), ray_(medium.ray(position, direction)), random_(random) {}

    float transmittance(float power) {
        if (power == power_) return transmittance_;
        power_ = power;
        Random random = random_;
        return transmittance_ = ratio_track(medium_, ray_, power, random);
    }

  private:
    const Medium& medium_;
    LocalRay ray_;
    Random random_;
    float power_ = 0.0f, transmittance_ = 1.0f;
};

}  // namespace

DirectLight::DirectLight(const Scene& scene, const std::vector<Look>& looks, Sky sky)
    : scene_(scene), looks_(looks), sky_(sky) {}

void DirectLight::set_terms(int first, int last) {
    if (first == first_ && last == last_) return;
    first_ = first;
    last_ = last;
    terms_.clear();
    for (std::size_t k = 0; k < looks_.size(); ++k) {
        for (int i = first; i < last; ++i) {
            const Look& look = looks_[k];
            const auto power = [i](float base) { return std::pow(base, static_cast<float>(i)); };
            terms_.push_back({k, i, power(look.b),
                              HenyeyGreenstein(power(look.c) * scene_.medium.phase().g()),
                              power(look.a), sky_ == Sky::walk && look.physical()});
        }
    }
}

void DirectLight::add(const ScatterEvent& event, int first, int last, const PathRandom& random,
                      PathRecord& record) {
    // After the first event light is asked for with a chance that grows with what the phase
    // function lets through: most directions lie far off its peak. b has no say, so that it can be
    // regraded.
    const float roulette =
        first == 0 ? 0.0f
                   : random.stream(roulette_stream, static_cast<std::uint64_t>(first), 0).uniform();
    const auto chance = [&](float scattered) {
        return first == 0 ? 1.0f : std::min(1.0f, 4.0f * scattered);
    };

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
        const float u1 = first == 0 ? random.second[0] : stream.uniform();
        const float u2 = first == 0 ? random.second[1] : stream.uniform();
        if (const auto sample = light.sample(u1, u2)) {
            const bool hit = light.can_be_hit();
            const float lobe_density =
                hit ? lobe.density(event.direction, sample->direction) : 0.0f;
            const float walk_density =
                hit ? phase.density(event.direction, sample->direction) : 0.0f;
            Shadow shadow(scene_.medium, event.position, sample->direction, stream);
            for (const Term& term : terms_) {
                const float rival = term.walk ? walk_density : lobe_density;
                const float share =
                    rival > 0.0f ? sample->density / (sample->density + rival) : 1.0f;
                const float scattered =
                    share * term.phase.density(event.direction, sample->direction);
                const float asked = chance(4.0f * pi * scattered);
                if (roulette >= asked) continue;
                record.add(
                    term.look, term.order,
                    event.weight * sample->radiance *
                        (term.weight * scattered / asked * shadow.transmittance(term.power)));
            }
        }
        // ... and the phase function's, weighed against each other by the balance heuristic (Veach
        // 1997).
        if (!light.can_be_hit() || all_walk) continue;
        Random lobe_random = random.stream(lobe_stream, order, l);
        const float choice = first == 0 ? random.first[3] : lobe_random.uniform();
        const float v1 = first == 0 ? random.second[0] : lobe_random.uniform();
        const float v2 = first == 0 ? random.second[1] : lobe_random.uniform();
        const V3f direction = lobe.sample(event.direction, choice, v1, v2);
        const float density = lobe.density(event.direction, direction) + light.density(direction);
        const Color radiance = light.radiance(direction);
        if (!(density > 0.0f) || radiance == Color(0.0f)) continue;
        Shadow shadow(scene_.medium, event.position, direction, lobe_random);
        for (const Term& term : terms_) {
            if (term.walk) continue;
            const float scattered = term.phase.density(event.direction, direction) / density;
            const float asked = chance(scattered);
            if (roulette >= asked) continue;
            record.add(term.look, term.order,
                       event.weight * radiance *
                           (term.weight * scattered / asked * shadow.transmittance(term.power)));
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
