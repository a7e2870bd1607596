#include "path.h"

#include "tracking.h"

#include <algorithm>
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
    Shadow(const Medium& medium, const V3f& position, const V3f& direction, float rate,
           const Random& random)
        : medium_(medium), ray_(medium.ray(position, direction)), rate_(rate), random_(random) {}

    float transmittance(float power) {
        if (power == power_) return transmittance_;
        power_ = power;
        Random random = random_;
        return transmittance_ = ratio_track(medium_, ray_, power, rate_, random);
    }

  private:
    const Medium& medium_;
    LocalRay ray_;
    float rate_;
    Random random_;
    float power_ = 0.0f, transmittance_ = 1.0f;
};

/// The chance with which light is asked for that would count `brightness` times as much as it does
/// under an isotropic phase function: most directions lie far off the phase function's peak. b has
/// no say, so that it can be regraded.
float chance(float brightness) { return std::min(1.0f, brightness); }

}  // namespace

DirectLight::DirectLight(const Scene& scene, const Schedule& schedule,
                         const std::vector<Look>& looks, Flights flights)
    : scene_(scene),
      schedule_(schedule),
      looks_(looks),
      tracked_(flights == Flights::tracked),
      all_walk_(tracked_ && std::all_of(looks.begin(), looks.end(),
                                        [](const Look& look) { return look.physical(); })),
      reach_(tracked_ ? bridge_length(scene.medium.phase().g()) : 0),
      chains_(scene.lights.size()) {}

void DirectLight::set_terms(int first, int last) {
    if (first == first_ && last == last_) return;
    first_ = first;
    last_ = last;
    terms_.clear();
    for (std::size_t k = 0; k < looks_.size(); ++k) {
        for (int i = first; i < last; ++i) {
            const Look& look = looks_[k];
            const int order = schedule_.order(i);
            const auto power = [order](float base) {
                return base == 1.0f ? 1.0f : std::pow(base, static_cast<float>(order));
            };
            terms_.push_back({k, order, power(look.b),
                              HenyeyGreenstein(power(look.c) * schedule_.at(i).phase().g()),
                              power(look.a), tracked_ && look.physical()});
        }
    }
}

void DirectLight::add(const ScatterEvent& event, int first, int last, const PathRandom& random,
                      PathRecord& record) {
    set_terms(first, last);
    const HenyeyGreenstein& phase = schedule_.at(first).phase();
    const Medium& onward = schedule_.onward(first);
    const Lobe lobe(phase, last > 1);
    Random event_stream = random.stream(light_stream, static_cast<std::uint64_t>(first));
    const float roulette = first == 0 ? 0.0f : event_stream.uniform();
    // A path has one first event and many later ones, so there noise counts more and time less.
    const float rate = first == 0 ? 2.0f : 1.0f;
    const auto asked = [&](float brightness) { return first == 0 ? 1.0f : chance(brightness); };

    for (const auto& light : scene_.lights) {
        Random stream(event_stream.bits());
        const bool hit = light->can_be_hit();
        // The light's own directions ...
        const float u1 = first == 0 ? random.light()[0] : stream.uniform();
        const float u2 = first == 0 ? random.light()[1] : stream.uniform();
        if (const auto sample = light->sample(u1, u2)) {
            const float seen = phase.density(event.direction, sample->direction);
            const float lobe_density =
                hit ? lobe.density(event.direction, sample->direction) : 0.0f;
            float others = 0.0f;  // the inverse densities that the bridges weigh in
            if (!hit && bridged(first)) {
                others = event.choices.inverse(reach_);
            }
            Shadow shadow(onward, event.position, sample->direction, rate, stream);
            for (const Term& term : terms_) {
                const float rival = hit ? (term.walk ? seen : lobe_density) : 0.0f;
                const float share = rival > 0.0f ? sample->density / (sample->density + rival)
                                                 : 1.0f / (1.0f + seen * others);
                const float scattered =
                    share * term.phase.density(event.direction, sample->direction);
                const float odds = asked(4.0f * pi * scattered);
                if (roulette >= odds) continue;
                record.add(term.look, term.order,
                           event.weight * sample->radiance *
                               (term.weight * scattered / odds * shadow.transmittance(term.power)));
            }
        }
        // ... and the phase function's, weighed against each other by the balance heuristic (Veach
        // 1997).
        if (!hit || all_walk_) continue;
        Random lobe_stream(stream.bits());
        const float choice = first == 0 ? random.first[3] : lobe_stream.uniform();
        const float v1 = first == 0 ? random.light()[0] : lobe_stream.uniform();
        const float v2 = first == 0 ? random.light()[1] : lobe_stream.uniform();
        const V3f direction = lobe.sample(event.direction, choice, v1, v2);
        const float density = lobe.density(event.direction, direction) + light->density(direction);
        const Color radiance = light->radiance(direction);
        if (!(density > 0.0f) || radiance == Color(0.0f)) continue;
        Shadow shadow(onward, event.position, direction, rate, lobe_stream);
        for (const Term& term : terms_) {
            if (term.walk) continue;
            const float scattered = term.phase.density(event.direction, direction) / density;
            const float odds = asked(scattered);
            if (roulette >= odds) continue;
            record.add(term.look, term.order,
                       event.weight * radiance *
                           (term.weight * scattered / odds * shadow.transmittance(term.power)));
        }
    }
}

void DirectLight::add_bridges(const ScatterEvent& event, int n, int end, const PathRandom& random,
                              PathRecord& record) {
    if (n + 1 >= end || !bridged(n + 1)) return;
    const HenyeyGreenstein& phase = schedule_.at(n).phase();
    Random event_stream = random.stream(bridge_stream, static_cast<std::uint64_t>(n));
    for (std::size_t k = 0; k < scene_.lights.size(); ++k) {
        if (scene_.lights[k]->can_be_hit()) continue;
        const std::optional<Chain>& way = chain(k, n, random);
        if (!way) continue;
        const LightSample& light = way->light();
        for (int length = 1; length <= reach_ && n + length < end && bridged(n + length);
             ++length) {
            // Of all choices of which a bridge leaves one to be evaluated.
            const float inverse = way->inverse(length) +
                                  phase.inverse_density(event.direction, way->first(length)) +
                                  event.choices.inverse(reach_ - length);
            const float brightness = (n == 0 ? 4.0f : 2.0f) * pi / inverse;
            if (event_stream.uniform() >= chance(brightness)) continue;
            Random own(event_stream.bits());
            const auto arrival = fly(event, n, way->directions(length), own);
            if (!arrival) continue;
            set_terms(n + length, n + length + 1);
            Shadow shadow(schedule_.onward(n + length), arrival->position, light.direction, 1.0f,
                          own);
            for (const Term& term : terms_) {
                const float scattered =
                    term.phase.density(way->first(1), light.direction) * way->inverse(1) / inverse;
                record.add(term.look, term.order,
                           arrival->weight * light.radiance *
                               (term.weight * scattered / chance(brightness) *
                                shadow.transmittance(term.power)));
            }
        }
    }
}

/// The bridges' directions into a light. Neighbouring events share them: most bridges are not
/// taken, and of such a one there is little to do but to draw its directions.
const std::optional<Chain>& DirectLight::chain(std::size_t light, int n, const PathRandom& random) {
    constexpr int sharing = 4;
    if (n % sharing == 0) {
        Random stream =
            random.stream(chain_stream, static_cast<std::uint64_t>(n) * chains_.size() + light);
        const float u1 = stream.uniform(), u2 = stream.uniform();
        const auto sample = scene_.lights[light]->sample(u1, u2);
        chains_[light] =
            sample ? std::optional(Chain(*sample, schedule_.at(n).phase(), reach_, stream))
                   : std::nullopt;
    }
    return chains_[light];
}

/// Where a path comes to that flies on from event n along the directions of a chain, its last
/// first; nothing if it leaves the medium on its way.
std::optional<ScatterEvent> DirectLight::fly(const ScatterEvent& from, int n,
                                             std::span<const V3f> chain, Random& random) const {
    ScatterEvent event = from;
    for (auto direction = chain.rbegin(); direction != chain.rend(); ++direction) {
        const Medium& medium = schedule_.onward(n++);
        const LocalRay flight = medium.ray(event.position, *direction);
        const auto distance = delta_track(medium, flight, random.exponential(), random);
        if (!distance) return std::nullopt;
        event.position = flight.at(*distance);
        event.weight *= medium.albedo();
    }
    return event;
}

/// Whether light of event n's order also comes by bridges: where its lobe, and so those of the
/// events before it, is the medium's own and narrow.
bool DirectLight::bridged(int n) const { return reach_ > 0 && schedule_.plain(n); }

void DirectLight::add_escape(const ScatterEvent& event, const V3f& direction, float inverse_density,
                             int n, PathRecord& record) const {
    if (!tracked_) return;
    const int order = schedule_.order(n);
    for (const auto& light : scene_.lights) {
        if (!light->can_be_hit()) continue;
        const float share = 1.0f / (1.0f + inverse_density * light->density(direction));
        const Color radiance = event.weight * light->radiance(direction) * share;
        for (std::size_t k = 0; k < looks_.size(); ++k) {
            if (looks_[k].physical()) record.add(k, order, radiance);
        }
    }
}

}  // namespace pileus
