// Direct light at scatter events by Eq. 1, and the bridges by which it comes with less noise.
#pragma once

#include "path.h"
#include "scene.h"
#include "schedule.h"
#include "tracker.h"

#include <optional>
#include <span>
#include <vector>

namespace pileus {

/// Shadow rays from a path's events, and what each lets through to the path's record.
class ShadowRays {
  public:
    bool empty() const { return rays_.empty(); }

    /// Lays the rays down. They stay as they are until they are settled.
    void cast(Tracker& tracker) {
        for (Track& ray : rays_) tracker.add(Estimator::transmittance, ray);
    }

    /// Adds the light that has come through, once the rays have been tracked, and forgets them.
    void settle(PathRecord& record) {
        for (const Light& light : lights_)
            record.add(light.look, light.order, light.radiance * rays_[light.ray].weight);
        rays_.clear();
        lights_.clear();
    }

  private:
    friend class ShadowRay;

    struct Light {
        std::size_t ray, look;
        int order;
        Color radiance;  // before what the ray lets through
    };

    std::vector<Track> rays_;
    std::vector<Light> lights_;
};

/// Bridges that a path has under way to distant lights.
class Bridges {
  public:
    explicit Bridges(std::size_t lights) : chains_(lights) {}

    bool empty() const { return under_way_.empty(); }

  private:
    friend class DirectLight;

    struct Bridge {
        const Chain* chain;
        int n;               // the event that the flight leaves
        int left;            // flights to come, this one included
        Color weight;        // of the path up to that event
        float inverse_odds;  // of the chain's choices weighed with all others, and of being taken
        Track flight;
    };

    std::vector<std::optional<Chain>> chains_;  // by light
    std::vector<Bridge> under_way_;
};

/// How a method flies from event to event.
enum class Flights {
    tracked,  // delta tracking, unbiased
    local,    // the talk's steps, by the extinction where they start
    other
};

/// Adds the direct light at an event, Eq. 1 for the orders of the events [first, last), to every
/// look: for each light
///   sigma_s b^i L p(w_i, w_o, c^i g) exp(-a^i integral of sigma_t to the light).
/// Looks share the directions, and the shadow rays where they share the power a^i.
///
/// Two more techniques find the same light with less noise:
/// - where flights are tracked, the sky reaches a physical look (a = b = c = 1) by the walk itself
///   as it leaves the medium, at no cost (`add_escape`);
/// - where they are tracked or local, distant lights are also reached by bridges (`ask_bridges`),
///   which fly as the walk does. Of a path's last phase functions p one is then evaluated and the
///   others sampled. Weighed by the balance heuristic (Veach 1997) every technique counts the same,
///   the harmonic sum 1 / (sum of 1 / p): it has a peak only where all of them do.
class DirectLight {
  public:
    DirectLight(const Scene& scene, const Schedule& schedule, const std::vector<Look>& looks,
                Flights flights);

    /// Asks for the direct light of an event.
    void ask(const ScatterEvent& event, int first, int last, const PathRandom& random,
             ShadowRays& rays) const;

    /// Asks for the light that reaches event n by way of further events, up to event `end`, between
    /// it and each distant light.
    void ask_bridges(const ScatterEvent& event, int n, int end, const PathRandom& random,
                     Bridges& bridges) const;

    /// Lays down the next flights of bridges.
    void cast(Bridges& bridges, Tracker& tracker) const;

    /// Takes bridges on to their next flights, once the last ones have been tracked, and asks for
    /// the light at the ends of those that have arrived.
    void go_on(Bridges& bridges, ShadowRays& rays) const;

    /// Adds what a walk that has left the medium sees of the sky, for the physical looks: it
    /// scattered into `direction` at event n, of which 1 / density is given, and met nothing more.
    void add_escape(const ScatterEvent& event, const V3f& direction, float inverse_density, int n,
                    PathRecord& record) const;

  private:
    struct Term {
        std::size_t look;
        int order;
        float weight;
        HenyeyGreenstein phase;
        float power;
        bool walk;  // its sky comes by the walk
    };

    Term make_term(std::size_t look, int n) const;

    /// Calls visit(term) for every look and each of the events [first, last).
    template <class Visit>
    void for_terms(int first, int last, const Visit& visit) const {
        for (std::size_t look = 0; look < looks_.size(); ++look) {
            for (int n = first; n < last; ++n) {
                const std::size_t i = static_cast<std::size_t>(n) * looks_.size() + look;
                std::optional<Term> late;
                visit(i < terms_.size() ? terms_[i] : late.emplace(make_term(look, n)));
            }
        }
    }

    int events_within(float transport_lengths) const;
    const std::optional<Chain>& chain(Bridges& bridges, std::size_t light, int n,
                                      const PathRandom& random) const;
    Track flight(const V3f& position, const V3f& direction, int n, Random random,
                 float local) const;
    bool go_on(Bridges::Bridge& bridge, ShadowRays& rays) const;

    const Scene& scene_;
    const Schedule& schedule_;
    const std::vector<Look>& looks_;
    Flights flights_;
    bool all_walk_;
    bool asks_;  // whether any light is left to ask for at an event
    int reach_;  // the most events of a bridge; 0 where there are none

    // Events before this one come before a walk has lost its direction, four transport mean free
    // paths along it: what they see of the light differs from pixel to pixel the most, and is worth
    // more work.
    int early_;

    // Light of these events' orders also comes by bridges: where their lobe, and so those of the
    // events before, is the medium's own and narrow, and until so many have passed that what any
    // one of them sees counts little.
    int bridged_;

    std::vector<Term> terms_;  // of the first events, all looks of one after the other
};

}  // namespace pileus
