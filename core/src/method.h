// Transport methods: what one path of each does. A method is a page of code over the medium, the
// marches and the tracking; a new one is a file under methods/ and a line in method.cpp.
#pragma once

#include "camera_rays.h"
#include "direct_light.h"
#include "path_in_flight.h"

#include <memory>
#include <string>
#include <vector>

namespace pileus {

/// What a path in flight works with; the next path takes it over.
struct PathKit {
    PathKit(Tracker& with, std::size_t lights) : tracker(with), bridges(lights) {}

    /// Lays down the rays of the light that was asked for.
    void cast(const DirectLight& light) {
        shadows.cast(tracker);
        light.cast(bridges, tracker);
    }

    /// Once they have been tracked, adds what has come through. Returns whether further ones are to
    /// be cast.
    bool settle(const DirectLight& light, PathRecord& record) {
        shadows.settle(record);
        light.go_on(bridges, shadows);
        return !shadows.empty() || !bridges.empty();
    }

    Tracker& tracker;
    ShadowRays shadows;
    Bridges bridges;
};

/// One thread's instance of a method. Scene and transport outlive it.
class Method {
  public:
    virtual ~Method() = default;

    /// A path that follows the part of a camera ray that lies in the volume, and adds what it finds
    /// to the record. All that is given, and the method, must outlive the path.
    virtual Path trace(const CameraRay& ray, const PathRandom& random, PathRecord& record,
                       PathKit& kit) = 0;

    /// Of how many orders a path may ask for the light at one time.
    virtual int orders_at_once() const { return 1; }
};

/// The names a transport may have, in the order of the table in docs/methods.md.
std::vector<std::string> method_names();

/// The transport with its method's own number of bounces where none was asked for. Throws
/// InputError for a method, a number of bounces or a look that is out of range.
Transport resolve(Transport transport);

/// `transport` must be resolved.
std::unique_ptr<Method> make_method(const Scene& scene, const Transport& transport);

/// The most events that may come before the medium is reduced.
constexpr int longest_schedule = 1024;

/// Events after which any path ends, and is counted: a bound on work, far beyond what light needs.
constexpr int most_events = 1 << 20;

}  // namespace pileus
