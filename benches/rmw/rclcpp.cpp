// SPDX-License-Identifier: MIT OR Apache-2.0
// One end of round trips in rclcpp, with a SingleThreadedExecutor. It is told, measures and says what `client.py` does:
//   rclcpp near|far TOPIC BYTES MILLISECONDS CORE PRIORITY
// Or the time of a callback where all of so many subscriptions are ready:
//   rclcpp ready TOPIC SUBSCRIPTIONS MILLISECONDS CORE PRIORITY
// Built by hand, with a ROS 2 that is sourced, for `cargo xtask bench rmw -- --rclcpp PROGRAM`:
//   g++ -std=c++17 -O2 $(printf -- '-isystem %s ' "$AMENT_PREFIX_PATH"/include/*) benches/rmw/rclcpp.cpp -o PROGRAM
//     -L"$AMENT_PREFIX_PATH/lib" -lrclcpp -llibstatistics_collector -lrcl -lrmw -lrcutils -lrcpputils -ltracetools
//     -l{statistics,std,geometry}_msgs__rosidl_typesupport_cpp

#include <pthread.h>
#include <sched.h>
#include <unistd.h>

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <optional>
#include <string>
#include <thread>
#include <type_traits>
#include <vector>

#include <geometry_msgs/msg/twist.hpp>
#include <rclcpp/rclcpp.hpp>
#include <std_msgs/msg/u_int8_multi_array.hpp>

namespace
{
using Twist = geometry_msgs::msg::Twist;
using Bytes = std_msgs::msg::UInt8MultiArray;
using Clock = std::chrono::steady_clock;
using std::chrono::milliseconds;

constexpr size_t STRUCT_BYTES = 48;
// For an answer, for one until there was any, and for the first one.
constexpr milliseconds PATIENCE{500}, CONNECTING{50}, NEVER{20000};
constexpr size_t WARM_UP = 30;

struct Job
{
  bool is_near;
  std::string topic;
  size_t bytes;
  milliseconds budget;
};

void number(Twist & message, uint64_t number) {message.linear.x = static_cast<double>(number);}
void number(Bytes & message, uint64_t number) {std::memcpy(message.data.data(), &number, sizeof(number));}
uint64_t number_of(const Twist & message) {return static_cast<uint64_t>(message.linear.x);}
uint64_t number_of(const Bytes & message)
{
  uint64_t number = 0;
  std::memcpy(&number, message.data.data(), sizeof(number));
  return number;
}

void say(const std::vector<int64_t> & times, uint64_t lost, std::chrono::duration<double> length)
{
  std::printf("{\"Measured\": {\"times_ns\": [");
  for (size_t i = 0; i < times.size(); ++i) {
    std::printf("%s%ld", i == 0 ? "" : ", ", static_cast<long>(times[i]));
  }
  std::printf("], \"lost\": %lu, \"seconds\": %f}}\n", static_cast<unsigned long>(lost), length.count());
  std::fflush(stdout);
}

template<typename Message>
class End
{
public:
  explicit End(const Job & job)
  : job_(job), node_(std::make_shared<rclcpp::Node>(job.is_near ? "near" : "far"))
  {
    if constexpr (std::is_same_v<Message, Bytes>) {
      message_.data.resize(job.bytes);
    }
    const std::string there = job.topic + "/there", back = job.topic + "/back";
    publisher_ = node_->create_publisher<Message>(job.is_near ? there : back, rclcpp::QoS(10));
    subscription_ = node_->create_subscription<Message>(
      job.is_near ? back : there, rclcpp::QoS(10), [this](const Message & message) {
        if (job_.is_near) {
          answer_ = number_of(message);
        } else {
          publisher_->publish(message);
        }
      });
    executor_.add_node(node_);
  }

  void answer()
  {
    std::puts("{\"Ready\": null}");
    std::fflush(stdout);
    executor_.spin();
  }

  int round_trips()
  {
    const auto created = Clock::now();
    std::optional<Clock::time_point> connected, since;
    std::vector<int64_t> times;
    uint64_t sent = 0, lost = 0;
    for (size_t answers = 0;; ) {
      const auto start = Clock::now();
      if (since && start - *since >= job_.budget) {
        break;
      }
      if (!since && answers >= WARM_UP && start - *connected >= job_.budget / 8) {
        since = start;
      }
      number(message_, ++sent);
      publisher_->publish(message_);
      const auto end = start + (connected ? PATIENCE : CONNECTING);
      while (answer_ != sent && Clock::now() < end) {
        executor_.spin_once(end - Clock::now());
      }
      const auto now = Clock::now();
      if (answer_ == sent) {
        connected = connected.value_or(now);
        ++answers;
        if (since) {
          times.push_back(std::chrono::nanoseconds(now - start).count() / 2);
        }
      } else if (since) {
        ++lost;
      } else if (!connected && now - created > NEVER) {
        std::fputs("the other end did not answer\n", stderr);
        return 1;
      }
    }
    say(times, lost, Clock::now() - *since);
    return 0;
  }

private:
  Job job_;
  Message message_;
  uint64_t answer_ = 0;
  rclcpp::Node::SharedPtr node_;
  typename rclcpp::Publisher<Message>::SharedPtr publisher_;
  typename rclcpp::Subscription<Message>::SharedPtr subscription_;
  rclcpp::executors::SingleThreadedExecutor executor_;
};

template<typename Message>
int run(const Job & job)
{
  End<Message> end(job);
  if (job.is_near) {
    return end.round_trips();
  }
  end.answer();
  return 0;
}

// The last callback of a round publishes the next one.
int ready(const Job & job)
{
  const size_t count = job.bytes;
  const auto node = std::make_shared<rclcpp::Node>("near"), source = std::make_shared<rclcpp::Node>("source");
  rclcpp::executors::SingleThreadedExecutor executor;
  std::vector<rclcpp::Publisher<Twist>::SharedPtr> publishers;
  std::vector<rclcpp::Subscription<Twist>::SharedPtr> subscriptions;
  std::vector<int64_t> times;
  size_t heard = 0;
  Clock::time_point began, start;
  const auto publish = [&] {
      heard = 0;
      for (const auto & publisher : publishers) {
        publisher->publish(Twist());
      }
      start = Clock::now();
    };
  const auto hear = [&](const Twist &) {
      if (++heard < count) {
        return;
      }
      const auto now = Clock::now();
      times.push_back(std::chrono::nanoseconds(now - start).count() / static_cast<int64_t>(count));
      if (now - began >= job.budget) {
        executor.cancel();
      } else {
        publish();
      }
    };
  for (size_t i = 0; i < count; ++i) {
    const std::string topic = job.topic + "/of_" + std::to_string(i);
    subscriptions.push_back(node->create_subscription<Twist>(topic, rclcpp::QoS(10), hear));
    publishers.push_back(source->create_publisher<Twist>(topic, rclcpp::QoS(10)));
  }
  executor.add_node(node);
  for (const auto & publisher : publishers) {
    while (publisher->get_subscription_count() < 1) {
      std::this_thread::sleep_for(milliseconds(1));
    }
  }
  // Both sides know of each other soon after.
  const auto known = Clock::now() + 2 * CONNECTING;
  while (Clock::now() < known) {
    executor.spin_once(known - Clock::now());
  }
  began = Clock::now();
  publish();
  executor.spin();
  say(times, 0, Clock::now() - began);
  return 0;
}

// The RMW's threads inherit it.
bool pin(int core, int priority)
{
  cpu_set_t cores;
  CPU_ZERO(&cores);
  CPU_SET(core, &cores);
  const sched_param parameters{priority};
  return sched_setaffinity(0, sizeof(cores), &cores) == 0 &&
         (priority == 0 || sched_setscheduler(0, SCHED_FIFO, &parameters) == 0);
}
}  // namespace

int main(int argc, char ** argv)
{
  if (argc != 7) {
    std::fputs("usage: rclcpp near|far|ready TOPIC BYTES|SUBSCRIPTIONS MILLISECONDS CORE PRIORITY\n", stderr);
    return 2;
  }
  const Job job{argv[1] == std::string("near"), argv[2], std::stoul(argv[3]), milliseconds(std::stol(argv[4]))};
  if (!pin(std::stoi(argv[5]), std::stoi(argv[6]))) {
    std::perror("its core or its priority");
    return 1;
  }
  rclcpp::init(1, argv);
  // Whoever started it needs it no more when standard input is closed.
  std::thread(
    [] {
      char byte;
      while (read(0, &byte, 1) > 0) {
      }
      rclcpp::shutdown();
    }).detach();
  const int code = argv[1] == std::string("ready") ? ready(job) :
    job.bytes <= STRUCT_BYTES ? run<Twist>(job) : run<Bytes>(job);
  // The thread that reads may be shutting down: nothing is torn down under it.
  std::fflush(stdout);
  return code;
}
