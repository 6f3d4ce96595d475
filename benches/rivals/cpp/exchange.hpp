// SPDX-License-Identifier: MIT OR Apache-2.0
// What a system with a C or C++ interface sends and receives. What is measured, and when, is in lib.rs beside this file.
#pragma once

#include <unistd.h>

#include <cstdint>
#include <cstdio>
#include <cstring>
#include <functional>
#include <map>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace exchange {

// As in lib.rs.
extern "C" {
struct Job {
    const char* mode;
    size_t payload_bytes;
    int32_t depth;
    uint32_t domain;
    bool is_stream, is_round_trips, whole;

    bool has_mode(const char* name) const { return strcmp(mode, name) == 0; }
};
struct Stamp {
    uint64_t number, sent_ns;
};
using Arrive = void (*)(const void* to, Stamp stamp);
struct System {
    const char *name, *version;
    void* (*participant)(const Job*);
    void* (*outlet)(void* participant, const Job*, const char* topic);
    bool (*send)(void* outlet, Stamp);
    void* (*input)(void* participant, const Job*, const char* topic, Arrive, const void* to);
    void (*close)(void* input);
    void (*end)(void* participant);
};
int exchange_play(const System*);
void exchange_write(Stamp, void* out, size_t bytes, bool whole);
bool exchange_read(const void* from, size_t bytes, bool whole, Stamp*);
bool exchange_stopped();
}

[[noreturn]] inline void fail(const char* reason) {
    fprintf(stderr, "%s\n", reason);
    _exit(1);
}

[[noreturn]] inline void damaged(uint64_t number) {
    fail(("message " + std::to_string(number) + " arrived damaged").c_str());
}

// No exception may leave C++.
template <class Work>
auto guarded(Work work) -> decltype(work()) {
    try {
        return work();
    } catch (const std::exception& error) {
        fail(error.what());
    }
}

// The whole program of a system, by its Participant, made of the job, an Outlet, which sends to a topic or says that it was refused, and
// an Input, which has what arrives handled in another thread until it is closed. Outlets and inputs stay until the process ends.
template <class Participant, class Outlet, class Input>
int play(const char* name, const char* version) {
    static System system;
    system = {
        name,
        version,
        [](const Job* job) -> void* { return guarded([&] { return new Participant(*job); }); },
        [](void* participant, const Job* job, const char* topic) -> void* {
            return guarded([&] { return new Outlet(*static_cast<Participant*>(participant), *job, topic); });
        },
        [](void* outlet, Stamp stamp) { return guarded([&] { return static_cast<Outlet*>(outlet)->send(stamp); }); },
        [](void* participant, const Job* job, const char* topic, Arrive arrive, const void* to) -> void* {
            auto then = [arrive, to](Stamp stamp) { arrive(to, stamp); };
            return guarded([&] { return new Input(*static_cast<Participant*>(participant), *job, topic, then); });
        },
        [](void* input) { guarded([&] { static_cast<Input*>(input)->close(); }); },
        [](void* participant) { guarded([&] { delete static_cast<Participant*>(participant); }); },
    };
    return exchange_play(&system);
}

}  // namespace exchange
