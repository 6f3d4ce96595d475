// SPDX-License-Identifier: MIT OR Apache-2.0
// The five topics of `taut demo` with a subscriber in rclcpp, which knows nothing of Tautline. On rmw_tautline, TAUT_SYSTEM governs it:
// five.toml an executor for each callback group, each in a thread of its own, and one.toml one executor for all. On other RMWs it may
// set its threads' priorities and core by itself. At its end it prints what it saw.
//
//   five_topics five|one [CORE]
//   five_topics publisher [CORE] [SECONDS]

#include <pthread.h>
#include <sched.h>
#include <time.h>

#include <algorithm>
#include <cinttypes>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <iterator>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include <rclcpp/rclcpp.hpp>
#include <std_msgs/msg/u_int64.hpp>

using std_msgs::msg::UInt64;

namespace
{

struct Topic
{
  const char * name;
  int64_t period_ms;
  int64_t work_ms;
  int priority;
  // In an executor for all.
  int64_t deadline_ms;
};

// As five.toml and one.toml have them, the fastest first.
constexpr Topic TOPICS[] = {
  {"topic1", 10, 2, 20, 70}, {"topic2", 20, 4, 19, 100}, {"topic3", 50, 5, 18, 125}, {"topic4", 100, 15, 17, 190},
  {"topic5", 200, 50, 16, 200}};
// The publisher's, above its subscribers.
constexpr int PUBLISHER_PRIORITY = 24;
constexpr int64_t TICK_MS = 10;

int64_t now_ns(clockid_t clock)
{
  timespec time;
  clock_gettime(clock, &time);
  return time.tv_sec * 1'000'000'000LL + time.tv_nsec;
}

// Before the thread spins: what it inherits and what it makes is then as it is to be.
void become(int priority, int core)
{
  cpu_set_t cores;
  CPU_ZERO(&cores);
  CPU_SET(core, &cores);
  sched_param parameters{};
  parameters.sched_priority = priority;
  int error = pthread_setaffinity_np(pthread_self(), sizeof cores, &cores);
  if (error != 0) {
    std::fprintf(stderr, "five_topics: core %d: %s\n", core, std::strerror(error));
    std::exit(2);
  }
  error = pthread_setschedparam(pthread_self(), SCHED_FIFO, &parameters);
  if (error != 0) {
    std::fprintf(
      stderr, "five_topics: SCHED_FIFO %d: %s. Run it as root, or give your user 'rtprio 98' in /etc/security/limits.conf\n",
      priority, std::strerror(error));
    std::exit(2);
  }
}

// Uses the processor for so long, however often it is interrupted.
void work(int64_t ms)
{
  const int64_t end_ns = now_ns(CLOCK_THREAD_CPUTIME_ID) + ms * 1'000'000;
  while (now_ns(CLOCK_THREAD_CPUTIME_ID) < end_ns) {
  }
}

// What a callback saw of its messages, each of which is the time at which it was due.
struct Seen
{
  int64_t count = 0, lost = 0, late = 0, longest_ns = 0, last_ns = 0;

  void end(int64_t due_ns, int64_t period_ms, int64_t deadline_ms)
  {
    const int64_t response_ns = now_ns(CLOCK_MONOTONIC) - due_ns;
    lost += count == 0 ? 0 : (due_ns - last_ns) / (period_ms * 1'000'000) - 1;
    late += response_ns > deadline_ms * 1'000'000;
    longest_ns = std::max(longest_ns, response_ns);
    last_ns = due_ns;
    ++count;
  }
};

// Until it is interrupted. `core` is negative if a system file places the threads.
void subscribe(bool in_one, int core)
{
  auto node = std::make_shared<rclcpp::Node>("five_topics", rclcpp::NodeOptions().start_parameter_services(false));
  Seen seen[std::size(TOPICS)];
  std::vector<rclcpp::SubscriptionBase::SharedPtr> subscriptions;
  std::vector<rclcpp::CallbackGroup::SharedPtr> groups;
  for (size_t i = 0; i < std::size(TOPICS); ++i) {
    rclcpp::SubscriptionOptions options;
    options.callback_group = node->create_callback_group(rclcpp::CallbackGroupType::MutuallyExclusive, false);
    auto callback = [topic = TOPICS[i], in_one, &seen = seen[i]](const UInt64 & message) {
        work(topic.work_ms);
        seen.end(static_cast<int64_t>(message.data), topic.period_ms, in_one ? topic.deadline_ms : topic.period_ms);
      };
    subscriptions.push_back(node->create_subscription<UInt64>(TOPICS[i].name, 100, callback, options));
    groups.push_back(options.callback_group);
  }
  auto spin = [node, core](std::vector<rclcpp::CallbackGroup::SharedPtr> groups, int priority) {
      rclcpp::executors::SingleThreadedExecutor executor;
      for (const auto & group : groups) {
        executor.add_callback_group(group, node->get_node_base_interface());
      }
      if (core >= 0) {
        become(priority, core);
      }
      executor.spin();
    };
  std::vector<std::thread> threads;
  if (in_one) {
    threads.emplace_back(spin, groups, TOPICS[0].priority);
  }
  for (size_t i = 0; !in_one && i < groups.size(); ++i) {
    threads.emplace_back(spin, std::vector{groups[i]}, TOPICS[i].priority);
  }
  for (auto & thread : threads) {
    thread.join();
  }
  std::printf("topic   messages  longest ms  deadline ms  late  lost\n");
  for (size_t i = 0; i < std::size(TOPICS); ++i) {
    std::printf(
      "%s  %8" PRId64 "  %10.3f  %11" PRId64 "  %4" PRId64 "  %4" PRId64 "\n", TOPICS[i].name, seen[i].count,
      seen[i].longest_ns / 1e6, in_one ? TOPICS[i].deadline_ms : TOPICS[i].period_ms, seen[i].late, seen[i].lost);
  }
}

// All topics that are due, the fastest first, at absolute times.
void publish(int core, int64_t seconds)
{
  auto node = std::make_shared<rclcpp::Node>("five_topics_publisher");
  std::vector<rclcpp::Publisher<UInt64>::SharedPtr> publishers;
  for (const Topic & topic : TOPICS) {
    publishers.push_back(node->create_publisher<UInt64>(topic.name, 100));
  }
  for (const auto & publisher : publishers) {
    for (int looks = 0; rclcpp::ok() && publisher->get_subscription_count() == 0; ++looks) {
      if (looks == 100) {
        RCLCPP_INFO(node->get_logger(), "waiting for a subscriber of %s", publisher->get_topic_name());
      }
      std::this_thread::sleep_for(std::chrono::milliseconds(10));
    }
  }
  become(PUBLISHER_PRIORITY, core);
  const int64_t begin_ns = now_ns(CLOCK_MONOTONIC);
  UInt64 message;
  for (int64_t tick = 1; rclcpp::ok() && tick * TICK_MS <= seconds * 1'000; ++tick) {
    const int64_t due_ns = begin_ns + tick * TICK_MS * 1'000'000;
    const timespec due{due_ns / 1'000'000'000, due_ns % 1'000'000'000};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, nullptr) != 0 && rclcpp::ok()) {
    }
    for (size_t i = 0; i < publishers.size(); ++i) {
      if (tick * TICK_MS % TOPICS[i].period_ms == 0) {
        message.data = static_cast<uint64_t>(due_ns);
        publishers[i]->publish(message);
      }
    }
  }
}

}  // namespace

int main(int argc, char ** argv)
{
  const auto arguments = rclcpp::init_and_remove_ros_arguments(argc, argv);
  const std::string role = arguments.size() > 1 ? arguments[1] : "";
  const int core = arguments.size() > 2 ? std::atoi(arguments[2].c_str()) : -1;
  const int64_t seconds = arguments.size() > 3 ? std::atoll(arguments[3].c_str()) : 10;
  if (role == "five" || role == "one") {
    subscribe(role == "one", core);
  } else if (role == "publisher") {
    publish(core < 0 ? 1 : core, seconds);
  } else {
    std::fprintf(stderr, "usage: five_topics five|one [CORE]\n       five_topics publisher [CORE] [SECONDS]\n");
    return 2;
  }
  rclcpp::shutdown();
  return 0;
}
