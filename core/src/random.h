// Random numbers that depend on a key alone: SplitMix64 streams (Steele, Lea & Flood 2014) and, for
// a path's first dimensions, Sobol points with hash-based Owen scrambling (Burley 2020; Laine &
// Karras 2011).
#pragma once

#include <array>
#include <bit>
#include <cstdint>
#include <cstring>

namespace pileus {

/// The finaliser of SplitMix64: a bijection of 64-bit words with full avalanche.
constexpr std::uint64_t mix64(std::uint64_t x) {
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ULL;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebULL;
    return x ^ (x >> 31);
}

/// Folds one more word into a key.
constexpr std::uint64_t hash_key(std::uint64_t key, std::uint64_t word) {
    return mix64(key ^ (mix64(word + 0x9e3779b97f4a7c15ULL) + 0x9e3779b97f4a7c15ULL));
}

/// The 24 high bits of a word as a float in [0, 1).
constexpr float unit_float(std::uint32_t bits) { return static_cast<float>(bits >> 8) * 0x1p-24f; }

/// A stream of random numbers: the n-th is a function of (key, n).
class Random {
  public:
    explicit constexpr Random(std::uint64_t key) : state_(key) {}

    constexpr std::uint64_t bits() { return mix64(state_ += 0x9e3779b97f4a7c15ULL); }

    /// A stream with this key goes on as this one will.
    constexpr std::uint64_t state() const { return state_; }

    /// Uniform in [0, 1).
    constexpr float uniform() { return unit_float(static_cast<std::uint32_t>(bits() >> 32)); }

    /// Two of them, of one draw.
    constexpr std::array<float, 2> pair() {
        const std::uint64_t word = bits();
        return {unit_float(static_cast<std::uint32_t>(word >> 32)),
                unit_float(static_cast<std::uint32_t>(word))};
    }

  private:
    std::uint64_t state_;
};

namespace sobol {

constexpr int dimensions = 4;

template <class Word>
constexpr Word reverse_bits(Word x) {
    x = ((x >> 1) & 0x55555555u) | ((x & 0x55555555u) << 1);
    x = ((x >> 2) & 0x33333333u) | ((x & 0x33333333u) << 2);
    x = ((x >> 4) & 0x0f0f0f0fu) | ((x & 0x0f0f0f0fu) << 4);
    x = ((x >> 8) & 0x00ff00ffu) | ((x & 0x00ff00ffu) << 8);
    return (x >> 16) | (x << 16);
}

/// Direction numbers of the first four dimensions, from Joe & Kuo's primitive polynomials (2008).
constexpr std::array<std::array<std::uint32_t, 32>, dimensions> direction_numbers() {
    struct Polynomial {
        unsigned degree, coefficients;
        std::array<std::uint32_t, 3> initial;
    };
    constexpr std::array<Polynomial, 3> polynomials{
        {{1, 0, {1, 0, 0}}, {2, 1, {1, 3, 0}}, {3, 1, {1, 3, 1}}}};
    std::array<std::array<std::uint32_t, 32>, dimensions> v{};
    for (unsigned i = 0; i < 32; ++i) v[0][i] = 1u << (31 - i);
    for (unsigned d = 1; d < dimensions; ++d) {
        const auto& [s, a, m] = polynomials[d - 1];
        for (unsigned i = 0; i < 32; ++i) {
            if (i < s) {
                v[d][i] = m[i] << (31 - i);
                continue;
            }
            v[d][i] = v[d][i - s] ^ (v[d][i - s] >> s);
            for (unsigned k = 1; k < s; ++k) {
                if ((a >> (s - 1 - k)) & 1u) v[d][i] ^= v[d][i - k];
            }
        }
    }
    return v;
}

/// Four words, for arithmetic on all dimensions at once (GCC's and Clang's vectors).
using Words = std::uint32_t __attribute__((vector_size(16)));

/// A nested uniform (Owen) scramble of a mirrored word, its highest bit the least: each bit is
/// flipped by a hash of those below it.
template <class Word>
constexpr Word owen_scramble(Word x, Word seed) {
    x ^= x * 0x3d20adeau;
    x += seed;
    x *= (seed >> 16) | 1u;
    x ^= x * 0x05526c56u;
    return x ^ (x * 0x53a22864u);
}

/// The sum of direction numbers for each value of each byte of an index, both mirrored: a point
/// takes four look-ups.
struct ByteTable {
    alignas(16) std::array<std::array<std::array<std::uint32_t, dimensions>, 256>, 4> sums{};

    constexpr ByteTable() {
        constexpr auto directions = direction_numbers();
        for (unsigned byte = 0; byte < 4; ++byte) {
            for (unsigned value = 1; value < 256; ++value) {
                const auto lowest = static_cast<unsigned>(std::countr_zero(value));
                for (unsigned d = 0; d < dimensions; ++d) {
                    sums[byte][value][d] = sums[byte][value & (value - 1)][d] ^
                                           reverse_bits(directions[d][31 - (8 * byte + lowest)]);
                }
            }
        }
    }

    Words operator()(unsigned byte, std::uint32_t index) const {
        Words found;
        std::memcpy(&found, &sums[byte][(index >> (8 * byte)) & 0xffu], sizeof found);
        return found;
    }
};

/// Point `index` of the sequence that `key` names: four scrambled coordinates in [0, 1). Sequences
/// with different keys are shuffled against each other, so that they may be padded into higher
/// dimensions.
inline std::array<float, dimensions> point(std::uint32_t index, std::uint64_t key) {
    static constexpr ByteTable table;
    const std::uint32_t shuffled =
        owen_scramble(reverse_bits(index), static_cast<std::uint32_t>(mix64(key)));
    const Words x =
        table(0, shuffled) ^ table(1, shuffled) ^ table(2, shuffled) ^ table(3, shuffled);
    const std::uint64_t low = hash_key(key, 1), high = hash_key(key, 2);
    const Words seeds{static_cast<std::uint32_t>(low), static_cast<std::uint32_t>(low >> 32),
                      static_cast<std::uint32_t>(high), static_cast<std::uint32_t>(high >> 32)};
    const Words scrambled = reverse_bits(owen_scramble(x, seeds));
    std::array<float, dimensions> result{};
    for (int d = 0; d < dimensions; ++d)
        result[static_cast<unsigned>(d)] = unit_float(scrambled[d]);
    return result;
}

}  // namespace sobol
}  // namespace pileus
