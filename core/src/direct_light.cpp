#include "direct_light.h"

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
        return (sphere ? HenyeyGreenstein(0.0f) : phase_).sample(in, u1, u2).direction;
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

/// The way from an event to a light, for one power of its transmittance after the other. Each power
/// starts from the same random numbers, so a look does not notice the others.
class ShadowRay {
  public:
    ShadowRay(ShadowRays& rays, const Medium& medium, const V3f& position, const V3f& direction,
              float rate, float first, Random random)
        : rays_(rays),
          medium_(medium),
          position_(position),
          direction_(direction),
          rate_(rate),
          first_(first),
          random_(random) {}

    /// Light for the record, less what is lost on the way.
    void carry(std::size_t look, int order, float power, const Color& radiance) {
        if (power != power_) {
            power_ = power;
            rays_.rays_.push_back({.medium = &medium_,
                                   .ray = medium_.ray(position_, direction_),
                                   .random = random_,
                                   .first = first_,
                                   .power = power,
                                   .rate = rate_});
        }
        rays_.lights_.push_back({rays_.rays_.size() - 1, look, order, radiance});
    }

  private:
    ShadowRays& rays_;
    const Medium& medium_;
    const V3f& position_;
    const V3f& direction_;
    float rate_;
    float first_;
    Random random_;
    float power_ = -1.0f;  // of the ray that was laid down last
};

namespace {

bool has_directions(const std::shared_ptr<const Light>& light) {
    return light->sample(0.5f, 0.5f).has_value();
}

bool takes_bridges(const std::shared_ptr<const Light>& light) { return !light->can_be_hit(); }

/// The chance with which light is asked for that would count `brightness` times as much as it does
/// under an isotropic phase function: most directions lie far off the phase function's peak. b has
/// no say, so that it can be regraded.
float chance(float brightness, bool early) {
    return std::min(1.0f, (early ? 1.5f : 1.0f) * brightness);
}

}  // namespace

DirectLight::DirectLight(const Scene& scene, const Schedule& schedule,
                         const std::vector<Look>& looks, Flights flights)
    : scene_(scene),
      schedule_(schedule),
      looks_(looks),
      flights_(flights),
      all_walk_(flights == Flights::tracked &&
                std::all_of(looks.begin(), looks.end(),
                            [](const Look& look) { return look.physical(); })),
      asks_(!all_walk_ || std::any_of(scene.lights.begin(), scene.lights.end(), has_directions)),
      reach_(flights != Flights::other &&
                     std::any_of(scene.lights.begin(), scene.lights.end(), takes_bridges)
                 ? bridge_length(scene.medium.phase().g())
                 : 0),
      early_(events_within(4.0f)),
      bridged_(reach_ > 0 ? std::min(schedule.plain(), events_within(20.0f)) : 0) {
    constexpr int kept = 64;
    for (int n = 0; n < kept; ++n) {
        for (std::size_t look = 0; look < looks.size(); ++look)
            terms_.push_back(make_term(look, n));
    }
}

DirectLight::Term DirectLight::make_term(std::size_t look, int n) const {
    const Look& given = looks_[look];
    const int order = schedule_.order(n);
    const auto power = [order](float base) {
        return base == 1.0f ? 1.0f : std::pow(base, static_cast<float>(order));
    };
    return {look,           order,
            power(given.b), HenyeyGreenstein(power(given.c) * schedule_.at(n).phase().g()),
            power(given.a), flights_ == Flights::tracked && given.physical()};
}

void DirectLight::ask(const ScatterEvent& event, int first, int last, const PathRandom& random,
                      ShadowRays& rays) const {
    if (!asks_) return;
    const HenyeyGreenstein& phase = schedule_.at(first).phase();
    const Medium& onward = schedule_.onward(first);
    const Lobe lobe(phase, last > 1);
    Random event_stream = random.stream(light_stream, static_cast<std::uint64_t>(first));
    const float roulette = first == 0 ? 0.0f : event_stream.uniform();
    // A path has one first event, few early ones and many later ones: what their shadows' noise
    // counts falls, and the time it takes to have less of it grows.
    const float rate = first == 0 ? 3.0f : first < early_ ? 1.5f : 1.0f;
    const auto asked = [&](float brightness) {
        return first == 0 ? 1.0f : chance(brightness, first < early_);
    };

    float shadow = first == 0 ? random.light()[2] : event.shadow;
    for (const auto& light : scene_.lights) {
        Random stream(event_stream.bits());
        // Lights share the number, each turned on from the last (Cranley & Patterson 1976).
        shadow += shadow < 0.382f ? 0.618f : -0.382f;
        const bool hit = light->can_be_hit();
        // The light's own directions ...
        const auto numbers = [&](Random& from) {
            return first == 0 ? std::array{random.light()[0], random.light()[1]} : from.pair();
        };
        const auto [u1, u2] = numbers(stream);
        if (const auto sample = light->sample(u1, u2)) {
            const float seen = phase.density(event.direction, sample->direction);
            const float lobe_density =
                hit ? lobe.density(event.direction, sample->direction) : 0.0f;
            float others = 0.0f;  // the inverse densities that the bridges weigh in
            if (!hit && first < bridged_) {
                others = event.choices.inverse(reach_);
            }
            ShadowRay ray(rays, onward, event.position, sample->direction, rate, shadow, stream);
            for_terms(first, last, [&](const Term& term) {
                const float rival = hit ? (term.walk ? seen : lobe_density) : 0.0f;
                const float share = rival > 0.0f ? sample->density / (sample->density + rival)
                                                 : 1.0f / (1.0f + seen * others);
                const float scattered =
                    share * (term.phase.g() == phase.g()
                                 ? seen
                                 : term.phase.density(event.direction, sample->direction));
                const float odds = asked(4.0f * pi * scattered);
                if (roulette >= odds) return;
                ray.carry(term.look, term.order, term.power,
                          event.weight * sample->radiance * (term.weight * scattered / odds));
            });
        }
        // ... and the phase function's, weighed against each other by the balance heuristic (Veach
        // 1997).
        if (!hit || all_walk_) continue;
        Random lobe_stream(stream.bits());
        const float choice = first == 0 ? random.first[3] : lobe_stream.uniform();
        const auto [v1, v2] = numbers(lobe_stream);
        const V3f direction = lobe.sample(event.direction, choice, v1, v2);
        const float density = lobe.density(event.direction, direction) + light->density(direction);
        const Color radiance = light->radiance(direction);
        if (!(density > 0.0f) || radiance == Color(0.0f)) continue;
        const float u = lobe_stream.uniform();
        ShadowRay ray(rays, onward, event.position, direction, rate, u, lobe_stream);
        for_terms(first, last, [&](const Term& term) {
            if (term.walk) return;
            const float scattered = term.phase.density(event.direction, direction) / density;
            const float odds = asked(scattered);
            if (roulette >= odds) return;
            ray.carry(term.look, term.order, term.power,
                      event.weight * radiance * (term.weight * scattered / odds));
        });
    }
}

void DirectLight::ask_bridges(const ScatterEvent& event, int n, int end, const PathRandom& random,
                              Bridges& bridges) const {
    const int most = std::min(reach_, std::min(end, bridged_) - 1 - n);  // events of a bridge
    if (most < 1) return;
    const float brightness = (n == 0 ? 4.0f : 2.0f) * pi;
    const HenyeyGreenstein& phase = schedule_.at(n).phase();
    Random event_stream = random.stream(bridge_stream, static_cast<std::uint64_t>(n));
    for (std::size_t k = 0; k < scene_.lights.size(); ++k) {
        if (scene_.lights[k]->can_be_hit()) continue;
        const std::optional<Chain>& way = chain(bridges, k, n, random);
        if (!way) continue;
        const auto inverses = way->inverses(phase, event.direction);
        // Systematic sampling (Madow 1949): one number decides on all lengths.
        float until_taken = n == 0 ? random.light()[3] : event_stream.uniform();
        for (int length = 1; length <= most; ++length) {
            // Of all choices of which a bridge leaves one to be evaluated.
            const float inverse = inverses[static_cast<std::size_t>(length - 1)] +
                                  event.choices.inverse(reach_ - length);
            const float odds = chance(brightness / inverse, n < early_);
            until_taken -= odds;
            if (until_taken >= 0.0f) continue;
            until_taken += 1.0f;
            bridges.under_way_.push_back({&*way, n, length, event.weight, inverse * odds,
                                          flight(event.position, way->first(length), n,
                                                 Random(event_stream.bits()), event.local)});
        }
    }
}

/// The bridges' directions into a light. Neighbouring events share them: most bridges are not
/// taken, and of such a one there is little to do but to draw its directions.
const std::optional<Chain>& DirectLight::chain(Bridges& bridges, std::size_t light, int n,
                                               const PathRandom& random) const {
    constexpr int sharing = 4;
    std::optional<Chain>& chain = bridges.chains_[light];
    if (n % sharing == 0) {
        Random stream = random.stream(chain_stream,
                                      static_cast<std::uint64_t>(n) * scene_.lights.size() + light);
        const auto [u1, u2] = stream.pair();
        const auto sample = scene_.lights[light]->sample(u1, u2);
        const auto last = random.chain(n, stream);
        chain = sample
                    ? std::optional(Chain(*sample, schedule_.at(n).phase(), reach_, last, stream))
                    : std::nullopt;
    }
    return chain;
}

/// A bridge's flight from event n.
Track DirectLight::flight(const V3f& position, const V3f& direction, int n, Random random,
                          float local) const {
    const Medium& medium = schedule_.onward(n);
    const float first = random.uniform();
    return {.medium = &medium,
            .ray = medium.ray(position, direction),
            .random = random,
            .first = first,
            .local = local};
}

void DirectLight::cast(Bridges& bridges, Tracker& tracker) const {
    const auto estimator =
        flights_ == Flights::local ? Estimator::local_step : Estimator::collision;
    for (Bridges::Bridge& bridge : bridges.under_way_) tracker.add(estimator, bridge.flight);
}

void DirectLight::go_on(Bridges& bridges, ShadowRays& rays) const {
    auto kept = bridges.under_way_.begin();
    for (Bridges::Bridge& bridge : bridges.under_way_) {
        if (go_on(bridge, rays)) *kept++ = bridge;
    }
    bridges.under_way_.erase(kept, bridges.under_way_.end());
}

/// Takes a bridge on to its next flight. Returns false at its end.
bool DirectLight::go_on(Bridges::Bridge& bridge, ShadowRays& rays) const {
    const Track& flown = bridge.flight;
    if (flown.distance == Track::none) return false;
    const V3f position = flown.ray.at(flown.distance);
    Random random = flown.random;
    bridge.weight *= flown.medium->albedo();
    const int n = ++bridge.n;
    if (--bridge.left > 0) {
        bridge.flight = flight(position, bridge.chain->first(bridge.left), n, random, flown.local);
        return true;
    }
    const LightSample& light = bridge.chain->light();
    const float inverse_odds = bridge.inverse_odds / bridge.chain->inverse(1);
    const float u = random.uniform();
    ShadowRay ray(rays, schedule_.onward(n), position, light.direction, n < early_ ? 2.0f : 1.0f, u,
                  random);
    for_terms(n, n + 1, [&](const Term& term) {
        const float scattered =
            term.phase.density(bridge.chain->first(1), light.direction) / inverse_odds;
        ray.carry(term.look, term.order, term.power,
                  bridge.weight * light.radiance * (term.weight * scattered));
    });
    return false;
}

/// How many events of a walk come, on the mean, before it has gone so many transport mean free
/// paths.
int DirectLight::events_within(float transport_lengths) const {
    return static_cast<int>(std::ceil(transport_lengths / (1.0f - scene_.medium.phase().g())));
}

void DirectLight::add_escape(const ScatterEvent& event, const V3f& direction, float inverse_density,
                             int n, PathRecord& record) const {
    if (flights_ != Flights::tracked) return;
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
