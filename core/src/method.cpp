#include "method.h"

#include "error.h"
#include "methods/methods.h"

#include <algorithm>

namespace pileus {

namespace {

struct Registration {
    const char* name;
    std::optional<int> bounces;  // where none are asked for; nothing: unlimited
    bool fixed;                  // whether no other number makes sense
    std::unique_ptr<Method> (*make)(const Scene&, const Transport&);
};

constexpr Registration registry[] = {
    {"single", 1, true, make_contrast},
    {"contrast", 8, false, make_contrast},
    {"multiple", 16, false, make_multiple},
    {"density", 16, false, make_density},
    {"reference", std::nullopt, false, make_reference},
    {"similarity", std::nullopt, false, make_similarity},
};

const Registration& find(const std::string& name) {
    const auto* const found = std::find_if(std::begin(registry), std::end(registry),
                                           [&](const Registration& r) { return r.name == name; });
    if (found != std::end(registry)) return *found;
    std::string names;
    for (const auto& r : registry) names += (names.empty() ? "" : ", ") + std::string(r.name);
    throw InputError("transport.method \"" + name + "\" is not known; choose one of " + names);
}

}  // namespace

std::vector<std::string> method_names() {
    std::vector<std::string> names;
    for (const auto& r : registry) names.emplace_back(r.name);
    return names;
}

Transport resolve(Transport transport) {
    const Registration& registration = find(transport.method);
    if (!transport.max_bounces) transport.max_bounces = registration.bounces;
    if (transport.max_bounces &&
        (*transport.max_bounces < 1 || *transport.max_bounces > most_events)) {
        throw InputError("transport.max_bounces must lie between 1 and " +
                         std::to_string(most_events));
    }
    if (registration.fixed && transport.max_bounces != registration.bounces) {
        throw InputError("transport.max_bounces of \"" + transport.method + "\" is always " +
                         std::to_string(*registration.bounces) + "; leave it out");
    }
    if (transport.reduce_from < 1 || transport.reduce_from > longest_schedule)
        throw InputError("transport.reduce_from must lie between 1 and " +
                         std::to_string(longest_schedule));
    if (transport.looks.empty())
        throw InputError("transport.looks is empty; leave it out for a = b = c = 1");
    for (const Look& look : transport.looks) {
        for (const float value : {look.a, look.b, look.c}) {
            if (value >= 0.0f && value <= 1.0f) continue;
            throw InputError("transport.looks \"" + look.name +
                             "\": a, b and c must lie between 0 and 1");
        }
    }
    return transport;
}

std::unique_ptr<Method> make_method(const Scene& scene, const Transport& transport) {
    return find(transport.method).make(scene, transport);
}

}  // namespace pileus
