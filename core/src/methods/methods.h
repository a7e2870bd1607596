// The methods' makers, for the registry.
#pragma once

#include "../method.h"

namespace pileus {

std::unique_ptr<Method> make_contrast(const Scene& scene, const Transport& transport);
std::unique_ptr<Method> make_multiple(const Scene& scene, const Transport& transport);
std::unique_ptr<Method> make_density(const Scene& scene, const Transport& transport);
std::unique_ptr<Method> make_reference(const Scene& scene, const Transport& transport);
std::unique_ptr<Method> make_similarity(const Scene& scene, const Transport& transport);

}  // namespace pileus
