// SPDX-License-Identifier: MIT OR Apache-2.0
// What both ends of an exchange have in common, for systems with a C or C++ interface: the counterpart of the Rust package
// tautline-exchange. A process is told its job as words `key=value`; it says lines of JSON.
#pragma once

#include <malloc.h>
#include <pthread.h>
#include <sched.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <time.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <csignal>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace exchange {

inline uint64_t clock_ns(clockid_t clock) {
    timespec now;
    clock_gettime(clock, &now);
    return uint64_t(now.tv_sec) * 1000000000u + uint64_t(now.tv_nsec);
}
inline uint64_t monotonic_ns() { return clock_ns(CLOCK_MONOTONIC); }
inline uint64_t process_cpu_ns() { return clock_ns(CLOCK_PROCESS_CPUTIME_ID); }
inline void sleep_until(uint64_t ns) {
    timespec at{time_t(ns / 1000000000u), long(ns % 1000000000u)};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, nullptr) == EINTR) {
    }
}

constexpr uint64_t WARM_UP_SHARE = 8;
constexpr uint64_t PATIENCE_NS = 500000000;
constexpr uint64_t CONNECTING_NS = 50000000;
constexpr uint64_t SAMPLED = 16;
// Of a stream, between two messages of number 0, and for each of their bytes.
constexpr uint64_t GREETING_NS = 1000000;
constexpr uint64_t GREETING_NS_PER_BYTE = 20;
constexpr size_t ROOM = 1 << 16;

struct Job {
    bool near = false;
    std::string kind;  // round-trips, paced, stream
    std::string mode, topic;
    double rate = 0;
    size_t payload_bytes = 64, topics = 1, subscribers = 1;
    bool at_once = false;
    uint64_t budget_ns = 0;
    int core = -1;
    bool realtime = false, whole = false;
    uint32_t domain = 0;

    // Also binds the process, sets its priority and lets it end with its starter: threads inherit it.
    Job(int argc, char** argv) {
        std::map<std::string, std::string> words;
        for (int index = 1; index < argc; index++) {
            std::string word = argv[index];
            size_t at = word.find('=');
            if (at == std::string::npos) throw std::runtime_error("not key=value: " + word);
            words[word.substr(0, at)] = word.substr(at + 1);
        }
        auto take = [&words](const char* key) {
            auto word = words.find(key);
            if (word == words.end()) throw std::runtime_error(std::string("the job has no ") + key);
            std::string value = word->second;
            words.erase(word);
            return value;
        };
        near = take("role") == "near";
        kind = take("kind");
        mode = take("mode");
        topic = take("topic");
        rate = atof(take("rate").c_str());
        payload_bytes = strtoul(take("payload_bytes").c_str(), nullptr, 10);
        topics = strtoul(take("topics").c_str(), nullptr, 10);
        subscribers = strtoul(take("subscribers").c_str(), nullptr, 10);
        at_once = take("at_once") == "1";
        budget_ns = strtoull(take("budget_ns").c_str(), nullptr, 10);
        std::string on_core = take("core");
        core = on_core.empty() ? -1 : atoi(on_core.c_str());
        realtime = take("realtime") == "1";
        whole = take("whole") == "1";
        domain = uint32_t(atoi(take("domain").c_str()));
        if (!words.empty()) throw std::runtime_error("the job has an unknown " + words.begin()->first);
        if (kind.empty() || topic.empty() || payload_bytes < 16) throw std::runtime_error("the job is incomplete");
        prctl(PR_SET_PDEATHSIG, SIGKILL);
        if (core >= 0) {
            cpu_set_t cores;
            CPU_ZERO(&cores);
            CPU_SET(core, &cores);
            if (sched_setaffinity(0, sizeof cores, &cores) != 0) throw std::runtime_error("the core is refused");
        }
        sched_param priority{};
        priority.sched_priority = 50;
        if (realtime && sched_setscheduler(0, SCHED_FIFO, &priority) != 0)
            throw std::runtime_error("SCHED_FIFO 50 is refused");
        // As Tautline's context does: what was used once faults no page again.
        mallopt(M_TRIM_THRESHOLD, -1);
        mallopt(M_MMAP_MAX, 0);
        if (mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT) != 0 && realtime)
            throw std::runtime_error("locked memory is refused");
    }
    // Messages that a queue has room for, whatever the system.
    int32_t depth() const { return is_stream() && payload_bytes <= (64u << 10) ? 100 : 10; }
    bool is_round_trips() const { return kind == "round-trips"; }
    bool is_stream() const { return kind == "stream"; }
    std::string there() const { return topic + (near ? "/there" : "/back"); }
    std::string back() const { return topic + (near ? "/back" : "/there"); }
};

inline void say(const std::string& line) {
    static std::mutex out;
    std::lock_guard<std::mutex> lock(out);
    fwrite(line.data(), 1, line.size(), stdout);
    fputc('\n', stdout);
    fflush(stdout);
}

// Set when standard input is closed.
inline std::atomic<bool>& stop_flag() {
    static std::atomic<bool> stop{false};
    static std::thread reader([] {
        char buffer[256];
        while (read(0, buffer, sizeof buffer) > 0) {
        }
        stop = true;
    });
    if (reader.joinable()) reader.detach();
    return stop;
}

inline void wait_for_stop() {
    while (!stop_flag()) sleep_until(monotonic_ns() + 20000000);
}

[[noreturn]] inline void damaged(uint64_t number) {
    fprintf(stderr, "message %lu arrived damaged\n", number);
    _exit(1);
}

struct Stamp {
    uint64_t number = 0, sent_ns = 0;

    void write(void* out, size_t bytes, bool whole) const {
        auto* to = static_cast<uint8_t*>(out);
        if (whole)
            for (size_t at = 16; at + 8 <= bytes; at += 8) memcpy(to + at, &number, 8);
        memcpy(to, &number, 8);
        memcpy(to + 8, &sent_ns, 8);
    }
    // One that is damaged ends the process.
    static Stamp read(const void* in, size_t bytes, bool whole) {
        Stamp stamp;
        if (!stamp.take(in, bytes, whole)) damaged(stamp.number);
        return stamp;
    }
    // Whether all of it says the same number.
    bool take(const void* in, size_t bytes, bool whole) {
        auto* from = static_cast<const uint8_t*>(in);
        memcpy(&number, from, 8);
        memcpy(&sent_ns, from + 8, 8);
        uint64_t difference = 0;
        if (whole)
            for (size_t at = 16; at + 8 <= bytes; at += 8) {
                uint64_t word;
                memcpy(&word, from + at, 8);
                difference |= word ^ number;
            }
        return difference == 0;
    }
};

// Resident memory: what several processes have mapped counts in part for each.
struct Memory {
    uint64_t kib = 0, shared_kib = 0;

    void add(const std::string& process) {
        if (FILE* file = fopen(("/proc/" + process + "/smaps_rollup").c_str(), "r")) {
            char line[256];
            while (fgets(line, sizeof line, file) != nullptr) {
                unsigned long number;
                if (sscanf(line, "Pss: %lu", &number) == 1) kib += number;
                if (sscanf(line, "Pss_Shmem: %lu", &number) == 1) shared_kib += number;
            }
            fclose(file);
        }
    }
    // Of this process and of the other ones of the exchange, now: later, when one has gone, what they shared would count for
    // the others.
    static Memory of_exchange() {
        Memory memory;
        memory.add("self");
        const char* peers = getenv("TAUTLINE_EXCHANGE_PEERS");
        std::string rest = peers == nullptr ? "" : peers;
        while (!rest.empty()) {
            size_t end = rest.find(',');
            memory.add(rest.substr(0, end));
            rest = end == std::string::npos ? "" : rest.substr(end + 1);
        }
        return memory;
    }
};

struct Measured {
    std::vector<uint64_t> times_ns, numbers;
    uint64_t lost = 0, cpu_ns = 0, messages = 0, late = 0, refused = 0;
    Memory memory;
    double seconds = 0;

    void say() const {
        auto list = [](const std::vector<uint64_t>& values) {
            std::string text = "[";
            for (size_t index = 0; index < values.size(); index++)
                text += (index ? "," : "") + std::to_string(values[index]);
            return text + "]";
        };
        exchange::say("{\"Measured\":{\"times_ns\":" + list(times_ns) + ",\"numbers\":" + list(numbers) +
                      ",\"lost\":" + std::to_string(lost) + ",\"cpu_ns\":" + std::to_string(cpu_ns) +
                      ",\"memory\":{\"kib\":" + std::to_string(memory.kib) +
                      ",\"shared_kib\":" + std::to_string(memory.shared_kib) + "},\"messages\":" + std::to_string(messages) +
                      ",\"late\":" + std::to_string(late) + ",\"refused\":" + std::to_string(refused) +
                      ",\"seconds\":" + std::to_string(seconds) + "}}");
    }
};

inline void say_ready() { say("{\"Ready\":null}"); }

// The clock of round trips; its user holds a lock if several threads use it.
class RoundTrips {
  public:
    explicit RoundTrips(const Job& job) : budget_ns_(job.budget_ns), created_ns_(monotonic_ns()) {
        measured_.times_ns.reserve(1 << 18);
    }
    // The number to send, or 0 when enough was measured.
    uint64_t start() {
        uint64_t now = monotonic_ns();
        if (since_ns_ != 0 && now - since_ns_ >= budget_ns_) return 0;
        uint64_t warming_ns = now - connected_ns_;
        // One that loses most of its messages warms up for ever.
        if (since_ns_ == 0 && connected_ns_ != 0 && warming_ns >= budget_ns_ / WARM_UP_SHARE &&
            (answers_ >= 30 || warming_ns >= budget_ns_ * 2)) {
            since_ns_ = now;
            cpu_ns_ = process_cpu_ns();
        }
        started_ns_ = now;
        return ++number_;
    }
    bool end(uint64_t answer) {
        uint64_t now = monotonic_ns();
        if (answer != number_) return false;
        answers_++;
        if (connected_ns_ == 0) connected_ns_ = now;
        if (since_ns_ != 0) measured_.times_ns.push_back((now - started_ns_) / 2);
        return true;
    }
    bool is_overdue() const {
        return monotonic_ns() - started_ns_ >= (connected_ns_ == 0 ? CONNECTING_NS : PATIENCE_NS);
    }
    void give_up() {
        if (since_ns_ != 0) measured_.lost++;
        if (connected_ns_ == 0 && monotonic_ns() - created_ns_ > 20000000000u) {
            fprintf(stderr, "the other end did not answer in 20 s\n");
            _exit(1);
        }
    }
    Measured& measured() {
        measured_.cpu_ns = process_cpu_ns() - cpu_ns_;
        measured_.memory = Memory::of_exchange();
        measured_.messages = measured_.times_ns.size();
        measured_.seconds = double(monotonic_ns() - since_ns_) / 1e9;
        return measured_;
    }

  private:
    Measured measured_;
    uint64_t budget_ns_, created_ns_, number_ = 0, started_ns_ = 0, connected_ns_ = 0, since_ns_ = 0, cpu_ns_ = 0,
                                      answers_ = 0;
};

// The near end of round trips, whose answers come in another thread.
class Asking {
  public:
    Asking(const Job& job, std::function<void(Stamp)> send) : trips_(job), send_(std::move(send)) {}
    void answered(uint64_t number) {
        std::lock_guard<std::mutex> lock(mutex_);
        if (trips_.end(number)) start();
    }
    // Until enough was measured.
    void run() {
        std::unique_lock<std::mutex> lock(mutex_);
        start();
        while (!is_done_) {
            lock.unlock();
            sleep_until(monotonic_ns() + CONNECTING_NS);
            lock.lock();
            if (!is_done_ && trips_.is_overdue()) {
                trips_.give_up();
                start();
            }
        }
    }
    Measured& measured() { return trips_.measured(); }

  private:
    void start() {
        if (is_done_) return;
        if (uint64_t number = trips_.start()) send_(Stamp{number, monotonic_ns()});
        else is_done_ = true;
    }
    RoundTrips trips_;
    std::function<void(Stamp)> send_;
    std::mutex mutex_;
    bool is_done_ = false;
};

// Numbers of a flow.
struct Numbers {
    uint64_t warm = 0, last = 0, period_ns = 0;

    explicit Numbers(const Job& job) {
        if (job.is_stream()) return;
        double exact = job.rate * double(job.budget_ns) / 1e9 / double(job.topics);
        auto measured = uint64_t(exact);
        measured = std::max<uint64_t>(measured + (double(measured) < exact), 1);
        warm = (measured + WARM_UP_SHARE - 1) / WARM_UP_SHARE;
        last = warm + measured;
        period_ns = uint64_t(1e9 / job.rate);
    }
};

// The near end of a flow: says which topic gets which message when.
class Source {
  public:
    explicit Source(const Job& job) : numbers_(job), topics_(job.topics), is_stream_(job.is_stream()),
                                      at_once_(job.at_once),
                                      budget_ns_(job.budget_ns),
                                      greeting_ns_(job.is_stream()
                                          ? std::max(GREETING_NS, GREETING_NS_PER_BYTE * uint64_t(job.payload_bytes))
                                          : numbers_.period_ns * job.topics) {}
    bool next(size_t& topic, Stamp& stamp) {
        topic = size_t(sent_ % topics_);
        if (started_ns_ == 0) {
            if (topic == 0) {
                if (stop_flag()) {
                    sent_ = 0;
                    started_ns_ = monotonic_ns() + greeting_ns_;
                }
                sleep_until(monotonic_ns() + greeting_ns_);
            }
            if (started_ns_ == 0) sent_++;
            stamp = Stamp{0, monotonic_ns()};
            return true;
        }
        uint64_t number = sent_ / topics_ + 1, now = monotonic_ns(), sent_ns = 0;
        bool is_warm, is_late = false;
        if (is_stream_) {
            if (now > started_ns_ && now - started_ns_ >= budget_ns_ / WARM_UP_SHARE + budget_ns_) return false;
            is_warm = now > started_ns_ && now - started_ns_ >= budget_ns_ / WARM_UP_SHARE;
        } else {
            // What was due while the message before was still being sent is stamped with the time at which it was due.
            // Of those that are sent at once, the first is waited for.
            bool follows = at_once_ && topic != 0;
            uint64_t due = started_ns_ + (at_once_ ? sent_ - topic : sent_) * numbers_.period_ns;
            is_late = !follows && now > due;
            if (is_late) {
                sent_ns = due;
            } else if (!follows) {
                sleep_until(due);
                now = monotonic_ns();
            }
            if (number > numbers_.last) return false;
            is_warm = number > numbers_.warm;
        }
        if (is_warm && since_ns_ == 0) {
            since_ns_ = now;
            cpu_ns_ = process_cpu_ns();
            before_ = sent_;
        }
        if (is_late && is_warm) late_++;
        sent_++;
        stamp = Stamp{number, is_late ? sent_ns : now};
        return true;
    }
    Measured measured() const {
        Measured measured;
        measured.cpu_ns = process_cpu_ns() - cpu_ns_;
        measured.seconds = double(monotonic_ns() - since_ns_) / 1e9;
        measured.memory = Memory::of_exchange();
        measured.messages = sent_ - before_;
        measured.late = late_;
        measured.refused = refused_;
        return measured;
    }
    // The system did not take a message.
    void refuse() { refused_++; }

  private:
    Numbers numbers_;
    uint64_t topics_, sent_ = 0, started_ns_ = 0, since_ns_ = 0, cpu_ns_ = 0, before_ = 0, late_ = 0, refused_ = 0;
    bool is_stream_, at_once_;
    uint64_t budget_ns_, greeting_ns_;
};

// The far end of a flow: what arrives at all subscriptions of the process.
class Sink {
  public:
    class Inlet {
      public:
        explicit Inlet(Sink& sink) : sink_(sink) { times_.reserve(ROOM / sink.topics_); }
        void arrive(Stamp stamp) {
            uint64_t now = monotonic_ns();
            std::lock_guard<std::mutex> lock(mutex_);
            if (!is_connected_) {
                is_connected_ = true;
                sink_.connect(now);
            }
            if (stamp.number == 0) return;
            if (!sink_.is_stream_) {
                if (stamp.number <= sink_.numbers_.warm) return;
                begin(now);
                received_++;
                times_.emplace_back(stamp.number, now > stamp.sent_ns ? now - stamp.sent_ns : 0);
            } else {
                if (first_ns_ == 0) first_ns_ = now;
                if (since_ns_ != 0) {
                    received_++;
                    if (stamp.number > last_number_ + 1) lost_ += stamp.number - last_number_ - 1;
                    if (received_ % SAMPLED == 0 && times_.size() < ROOM) {
                        times_.emplace_back(stamp.number, (now - sampled_ns_) / SAMPLED);
                        sampled_ns_ = now;
                    }
                } else if (now - first_ns_ >= sink_.budget_ns_ / WARM_UP_SHARE) {
                    begin(now);
                    sampled_ns_ = now;
                }
                last_number_ = stamp.number;
            }
            last_ns_ = now;
            if (!sink_.is_stream_ && stamp.number == sink_.numbers_.last) sink_.complete(now);
        }

      private:
        friend class Sink;
        void begin(uint64_t now) {
            if (since_ns_ == 0) since_ns_ = now;
            uint64_t none = 0;
            if (sink_.cpu_ns_ == 0 && sink_.cpu_ns_.compare_exchange_strong(none, process_cpu_ns())) say("\"Warm\"");
        }
        Sink& sink_;
        std::mutex mutex_;
        bool is_connected_ = false;
        std::vector<std::pair<uint64_t, uint64_t>> times_;
        uint64_t received_ = 0, lost_ = 0, last_number_ = 0, first_ns_ = 0, since_ns_ = 0, sampled_ns_ = 0, last_ns_ = 0;
    };

    explicit Sink(const Job& job) : numbers_(job), topics_(job.topics), is_stream_(job.is_stream()),
                                    budget_ns_(job.budget_ns) {
        for (size_t index = 0; index < job.topics * job.subscribers; index++)
            inlets.push_back(std::make_unique<Inlet>(*this));
    }
    // That of topic t is at t, t + topics, ...
    std::vector<std::unique_ptr<Inlet>> inlets;

    Measured measured() {
        Measured measured;
        measured.cpu_ns = (end_cpu_ns_ == 0 ? process_cpu_ns() : end_cpu_ns_.load()) - cpu_ns_;
        std::vector<std::pair<uint64_t, uint64_t>> arrivals;
        for (auto& inlet : inlets) {
            std::lock_guard<std::mutex> lock(inlet->mutex_);
            measured.messages += inlet->received_;
            uint64_t expected = numbers_.last - numbers_.warm;
            if (is_stream_) measured.lost += inlet->lost_;
            else if (expected > inlet->received_) measured.lost += expected - inlet->received_;
            if (inlet->since_ns_ != 0)
                measured.seconds = std::max(measured.seconds, double(inlet->last_ns_ - inlet->since_ns_) / 1e9);
            // So few of a stream that none was sampled.
            if (is_stream_ && inlet->times_.empty() && inlet->received_ > 0)
                arrivals.emplace_back(inlet->last_number_, (inlet->last_ns_ - inlet->since_ns_) / inlet->received_);
            arrivals.insert(arrivals.end(), inlet->times_.begin(), inlet->times_.end());
        }
        size_t subscribers = inlets.size() / topics_;
        if (topics_ == 1 && subscribers > 1) arrivals = to_the_last(arrivals, subscribers);
        for (auto& [number, time] : arrivals) {
            measured.times_ns.push_back(time);
            if (topics_ == 1) measured.numbers.push_back(number);
        }
        return measured;
    }

  private:
    static std::vector<std::pair<uint64_t, uint64_t>> to_the_last(std::vector<std::pair<uint64_t, uint64_t>> arrivals,
                                                                  size_t receivers) {
        std::sort(arrivals.begin(), arrivals.end());
        std::vector<std::pair<uint64_t, uint64_t>> last;
        for (size_t from = 0, to; from < arrivals.size(); from = to) {
            for (to = from; to < arrivals.size() && arrivals[to].first == arrivals[from].first;) to++;
            if (to - from == receivers) last.push_back(arrivals[to - 1]);
        }
        return last;
    }
    void connect(uint64_t now) {
        if (++connected_ == inlets.size()) say("{\"Connected\":{\"all_ns\":" + std::to_string(now) + "}}");
    }
    void complete(uint64_t now) {
        if (++complete_ < inlets.size()) return;
        end_cpu_ns_ = process_cpu_ns();
        say("{\"Complete\":{\"last_ns\":" + std::to_string(now) + "}}");
    }

    Numbers numbers_;
    size_t topics_;
    bool is_stream_;
    uint64_t budget_ns_;
    std::atomic<size_t> connected_{0}, complete_{0};
    std::atomic<uint64_t> cpu_ns_{0}, end_cpu_ns_{0};
};

// The ends of all exchanges, by a system's Participant, made of the job, an Outlet, which sends to a topic or says that it was
// refused, and an Input, which has what arrives handled in another thread until it is closed.
template <class Participant, class Outlet, class Input>
class Ends {
  public:
    explicit Ends(const Job& job) : job_(job), participant_(job) {}
    void play() {
        if (job_.is_round_trips()) job_.near ? ask() : answer();
        else job_.near ? send_flow() : receive_flow();
    }

  private:
    void ask() {
        Outlet out(participant_, job_, job_.there());
        Asking asking(job_, [&](Stamp stamp) { out.send(stamp); });
        Input input(participant_, job_, job_.back(), [&](Stamp answer) { asking.answered(answer.number); });
        asking.run();
        input.close();
        asking.measured().say();
    }
    void answer() {
        Outlet out(participant_, job_, job_.there());
        Input input(participant_, job_, job_.back(),
                    [&](Stamp question) { out.send(Stamp{question.number, monotonic_ns()}); });
        say_ready();
        wait_for_stop();
        input.close();
    }
    void send_flow() {
        std::vector<std::unique_ptr<Outlet>> outlets;
        for (size_t index = 0; index < job_.topics; index++)
            outlets.push_back(std::make_unique<Outlet>(participant_, job_, topic_of(index)));
        Source source(job_);
        size_t topic;
        Stamp stamp;
        while (source.next(topic, stamp))
            if (!outlets[topic]->send(stamp)) source.refuse();
        source.measured().say();
        // What is under way is repeated from its history.
        sleep_until(monotonic_ns() + 100000000);
    }
    void receive_flow() {
        Sink sink(job_);
        std::vector<std::unique_ptr<Input>> inputs;
        for (size_t index = 0; index < sink.inlets.size(); index++) {
            auto* inlet = sink.inlets[index].get();
            inputs.push_back(std::make_unique<Input>(participant_, job_, topic_of(index % job_.topics),
                                                     [inlet](Stamp stamp) { inlet->arrive(stamp); }));
        }
        say_ready();
        wait_for_stop();
        for (auto& input : inputs) input->close();
        sink.measured().say();
    }
    std::string topic_of(size_t index) const { return job_.topic + "/t" + std::to_string(index); }
    const Job& job_;
    Participant participant_;
};

// The whole program of a system.
template <class Participant, class Outlet, class Input>
int play(int argc, char** argv, const char* name, const char* version) try {
    if (argc == 2 && argv[1] == std::string("version")) {
        puts(version);
        return 0;
    }
    Job job(argc, argv);
    stop_flag();
    Ends<Participant, Outlet, Input>(job).play();
    return 0;
} catch (const std::exception& error) {
    fprintf(stderr, "%s: %s\n", name, error.what());
    return 1;
}

}  // namespace exchange
