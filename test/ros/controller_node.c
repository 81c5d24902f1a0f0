/* The node of examples/controller_node.py in C: rcl is the layer under rclpy and rclcpp. */
#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <rcl/error_handling.h>
#include <rcl/graph.h>
#include <rcl/rcl.h>
#include <std_msgs/msg/float64.h>
#include <std_msgs/msg/float64_multi_array.h>

enum { CISTERN, ROOF, FROST, RAIN, EVAPOTRANSPIRATION, INPUTS };

static const char * const names[INPUTS] = {
  "cistern/level", "roof/level", "weather/frost", "forecast/precipitation",
  "forecast/evapotranspiration"};
static const double target = 0.0457, suction = 0.75, gain = 20.0, full = 2.0;

static void check(rcl_ret_t code)
{
  if (code != RCL_RET_OK) {
    fprintf(stderr, "%s\n", rcl_get_error_string().str);
    exit(1);
  }
}

static double command(double cistern, double roof, double frost)
{
  if (frost != 0.0 || !isfinite(cistern) || !isfinite(roof) || cistern < suction) {
    return 0.0;
  }
  return fmin(fmax(gain * (target - roof), 0.0), 1.0);
}

static double opening(double cistern, double roof, double frost)
{
  return isfinite(frost) && isfinite(roof) && isfinite(cistern) && cistern > full ? 1.0 : 0.0;
}

int main(int argc, char ** argv)
{
  rcl_allocator_t memory = rcl_get_default_allocator();
  rcl_init_options_t init = rcl_get_zero_initialized_init_options();
  rcl_context_t context = rcl_get_zero_initialized_context();
  rcl_node_t node = rcl_get_zero_initialized_node();
  rcl_node_options_t node_options = rcl_node_get_default_options();
  check(rcl_init_options_init(&init, memory));
  check(rcl_init(argc, (const char * const *) argv, &init, &context));
  check(rcl_node_init(&node, "controller", "", &context, &node_options));

  const rosidl_message_type_support_t * number = ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, Float64);
  const rosidl_message_type_support_t * row =
    ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, Float64MultiArray);
  rcl_publisher_options_t out = rcl_publisher_get_default_options();
  out.qos.depth = 64;
  out.qos.durability = RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL;
  rcl_subscription_options_t in = rcl_subscription_get_default_options();
  in.qos = out.qos;
  out.qos.liveliness_lease_duration = (rmw_time_t) {.sec = 1, .nsec = 0};
  rcl_publisher_t publisher = rcl_get_zero_initialized_publisher();
  check(rcl_publisher_init(&publisher, &node, number, "pump/command", &out));
  const bool has_valve = argc > 1 && !strcmp(argv[1], "--valve");
  rcl_publisher_t valve = rcl_get_zero_initialized_publisher();
  if (has_valve) {
    check(rcl_publisher_init(&valve, &node, number, "outlet/command", &out));
  }
  rcl_subscription_t subscriptions[INPUTS];
  for (int i = 0; i < INPUTS; i++) {
    subscriptions[i] = rcl_get_zero_initialized_subscription();
    check(rcl_subscription_init(&subscriptions[i], &node, i < RAIN ? number : row, names[i], &in));
  }
  rcl_wait_set_t set = rcl_get_zero_initialized_wait_set();
  check(rcl_wait_set_init(&set, INPUTS, 0, 0, 0, 0, 0, &context, memory));

  double values[INPUTS] = {0.0};
  bool arrived[INPUTS] = {false};
  std_msgs__msg__Float64MultiArray forecast;
  std_msgs__msg__Float64MultiArray__init(&forecast);
  char clock[256];
  snprintf(clock, sizeof clock, "%s/clock", rcl_node_get_namespace(&node));
  const char * clock_name = clock[1] == '/' ? clock + 1 : clock;  /* without namespace: //clock */
  for (bool seen = false;;) {
    size_t plants;
    check(rcl_count_publishers(&node, clock_name, &plants));
    if (seen && !plants) {
      break;  /* the plant has ended */
    }
    seen = seen || plants;
    check(rcl_wait_set_clear(&set));
    for (int i = 0; i < INPUTS; i++) {
      /* The next tick's message stays in its queue until this tick is answered. */
      if (!arrived[i]) {
        check(rcl_wait_set_add_subscription(&set, &subscriptions[i], NULL));
      }
    }
    rcl_ret_t code = rcl_wait(&set, RCL_MS_TO_NS(500));
    if (code == RCL_RET_TIMEOUT) {
      continue;
    }
    check(code);
    int missing = 0;
    for (int i = 0; i < INPUTS; i++) {
      void * message = i < RAIN ? (void *) &values[i] : (void *) &forecast;
      if (!arrived[i]) {
        arrived[i] = rcl_take(&subscriptions[i], message, NULL, NULL) == RCL_RET_OK;
        rcl_reset_error();
      }
      missing += !arrived[i];
    }
    if (!missing) {
      std_msgs__msg__Float64 answer = {command(values[CISTERN], values[ROOF], values[FROST])};
      std_msgs__msg__Float64 share = {opening(values[CISTERN], values[ROOF], values[FROST])};
      for (int i = 0; i < INPUTS; i++) {
        arrived[i] = false;
      }
      check(rcl_publish(&publisher, &answer, NULL));
      if (has_valve) {
        check(rcl_publish(&valve, &share, NULL));
      }
    }
  }
  /* A node that ends without leaving the graph stays in it, for others, until its lease has passed. */
  for (int i = 0; i < INPUTS; i++) {
    check(rcl_subscription_fini(&subscriptions[i], &node));
  }
  check(rcl_publisher_fini(&publisher, &node));
  if (has_valve) {
    check(rcl_publisher_fini(&valve, &node));
  }
  check(rcl_node_fini(&node));
  check(rcl_shutdown(&context));
  return 0;
}
