/* FMI 2.0 for co-simulation around a sampled model: `sample` computes its outputs and its next state.

   A sample is taken at the start time and then every SAMPLING_TIME: it reads the inputs that are set at that moment.
   At a sampling instant the outputs are those of the state there and of the inputs set, so that they answer an input at
   once where the model does; between two instants they stay. Communication steps may have any length. */

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef void *fmi2Component, *fmi2ComponentEnvironment, *fmi2FMUstate;
typedef unsigned int fmi2ValueReference;
typedef double fmi2Real;
typedef int fmi2Integer, fmi2Boolean;
typedef const char *fmi2String;
typedef char fmi2Byte;
typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef enum { fmi2ModelExchange, fmi2CoSimulation } fmi2Type;
typedef enum { fmi2DoStepStatus, fmi2PendingStatus, fmi2LastSuccessfulTime, fmi2Terminated } fmi2StatusKind;
typedef struct {
  void (*logger)(fmi2ComponentEnvironment, fmi2String, fmi2Status, fmi2String, fmi2String, ...);
  void *(*allocateMemory)(size_t, size_t);
  void (*freeMemory)(void *);
  void (*stepFinished)(fmi2ComponentEnvironment, fmi2Status);
  fmi2ComponentEnvironment componentEnvironment;
} fmi2CallbackFunctions;

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define EXPORT __attribute__((visibility("default")))
#else
#define EXPORT
#endif
#ifdef FMI2_OVERRIDE_FUNCTION_PREFIX /* a library of its own; as source the names begin with that of the model */
#define NAME(function) function
#else
#define JOIN(prefix, function) prefix##_##function
#define PREFIXED(prefix, function) JOIN(prefix, function)
#define NAME(function) PREFIXED(MODEL, function)
#endif
#define STATUS EXPORT fmi2Status
#define UNUSED(value) (void)(value)

enum { VARIABLES = INPUTS + OUTPUTS + STATES, INSTANT_DIGITS = 1000000 }; /* instants agree to a share of a sample */
typedef enum { INSTANTIATED, INITIALISING, RUNNING, TERMINATED } Phase;

typedef struct { /* what a simulation remembers */
  double u[INPUTS + 1], x[STATES + 1], held[OUTPUTS + 1]; /* held: outputs between two instants */
  double start, time;
  long long count; /* of the next sample */
  Phase phase;
} Memory;

typedef struct {
  Memory now;
  const fmi2CallbackFunctions *callbacks;
  char *name;
} Instance;

static fmi2Status fail(const Instance *it, const char *format, ...) {
  char text[512];
  va_list values;
  va_start(values, format);
  vsnprintf(text, sizeof text, format, values);
  va_end(values);
  if (it->callbacks && it->callbacks->logger) /* the text has no per cent sign: it may stand for a format */
    it->callbacks->logger(it->callbacks->componentEnvironment, it->name, fmi2Error, "logStatusError", text);
  return fmi2Error;
}

static void reset(Memory *now) {
  memset(now, 0, sizeof *now);
  for (int i = 0; i < STATES; i++) now->x[i] = START[i];
}

/* The time of the next sample, in sampling times after the start. */
static double position(const Memory *now) { return (now->time - now->start) / SAMPLING_TIME; }

static int at_instant(const Memory *now) { return position(now) >= now->count - 1.0 / INSTANT_DIGITS; }

static fmi2Status take_sample(Instance *it) {
  Memory *now = &it->now;
  double next[STATES + 1];
  for (int i = 0; i < INPUTS; i++)
    if (!isfinite(now->u[i])) return fail(it, "input %s is not a finite number at time %g", NAMES[i], now->time);
  sample(now->x, now->u, next, now->held);
  memcpy(now->x, next, STATES * sizeof *next);
  for (int i = 0; i < OUTPUTS; i++)
    if (!isfinite(now->held[i])) return fail(it, "output %s left the range of numbers", NAMES[INPUTS + i]);
  now->count++;
  return fmi2OK;
}

EXPORT const char *NAME(fmi2GetTypesPlatform)(void) { return "default"; }
EXPORT const char *NAME(fmi2GetVersion)(void) { return "2.0"; }

STATUS NAME(fmi2SetDebugLogging)(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[]) {
  UNUSED(c), UNUSED(on), UNUSED(n), UNUSED(categories);
  return fmi2OK; /* errors are always reported */
}

EXPORT fmi2Component NAME(fmi2Instantiate)(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                                           const fmi2CallbackFunctions *callbacks, fmi2Boolean visible,
                                           fmi2Boolean logging) {
  UNUSED(resources), UNUSED(visible), UNUSED(logging);
  Instance *it = calloc(1, sizeof *it);
  if (!it) return NULL;
  it->callbacks = callbacks;
  it->name = calloc(strlen(name ? name : "") + 1, 1);
  if (it->name) strcpy(it->name, name ? name : "");
  reset(&it->now);
  if (it->name && type == fmi2CoSimulation && guid && !strcmp(guid, GUID)) return it;
  if (it->name)
    fail(it, type == fmi2CoSimulation ? "the guid is not that of the model description"
                                      : "the model is for co-simulation, not for model exchange");
  free(it->name);
  free(it);
  return NULL;
}

EXPORT void NAME(fmi2FreeInstance)(fmi2Component c) {
  if (!c) return;
  free(((Instance *)c)->name);
  free(c);
}

STATUS NAME(fmi2SetupExperiment)(fmi2Component c, fmi2Boolean has_tolerance, fmi2Real tolerance, fmi2Real start,
                                 fmi2Boolean has_stop, fmi2Real stop) {
  UNUSED(has_tolerance), UNUSED(tolerance), UNUSED(has_stop), UNUSED(stop);
  Instance *it = c;
  if (it->now.phase != INSTANTIATED) return fail(it, "fmi2SetupExperiment belongs before the initialisation");
  it->now.start = it->now.time = start;
  return fmi2OK;
}

static fmi2Status enter(Instance *it, Phase from, Phase to, const char *function) {
  if (it->now.phase != from) return fail(it, "%s is called out of order", function);
  it->now.phase = to;
  return fmi2OK;
}

STATUS NAME(fmi2EnterInitializationMode)(fmi2Component c) {
  return enter(c, INSTANTIATED, INITIALISING, "fmi2EnterInitializationMode");
}

STATUS NAME(fmi2ExitInitializationMode)(fmi2Component c) {
  return enter(c, INITIALISING, RUNNING, "fmi2ExitInitializationMode");
}

STATUS NAME(fmi2Terminate)(fmi2Component c) { return enter(c, RUNNING, TERMINATED, "fmi2Terminate"); }

STATUS NAME(fmi2Reset)(fmi2Component c) {
  reset(&((Instance *)c)->now);
  return fmi2OK;
}

STATUS NAME(fmi2DoStep)(fmi2Component c, fmi2Real time, fmi2Real step, fmi2Boolean no_earlier) {
  UNUSED(no_earlier);
  Instance *it = c;
  Memory *now = &it->now;
  if (now->phase != RUNNING) return fail(it, "fmi2DoStep belongs between initialisation and termination");
  if (!(step >= 0) || !isfinite(step)) return fail(it, "a communication step of %g", step);
  if (!(fabs(time - now->time) <= SAMPLING_TIME / INSTANT_DIGITS))
    return fail(it, "the communication point is %.12g, the model is at %.12g", time, now->time);
  double end = time + step;
  while (now->start + now->count * SAMPLING_TIME < end - SAMPLING_TIME / INSTANT_DIGITS) {
    fmi2Status status = take_sample(it);
    if (status != fmi2OK) return status;
  }
  now->time = end;
  return fmi2OK;
}

STATUS NAME(fmi2GetReal)(fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2Real values[]) {
  Instance *it = c;
  Memory *now = &it->now;
  double next[STATES + 1], y[OUTPUTS + 1];
  memcpy(y, now->held, sizeof y);
  if (at_instant(now)) sample(now->x, now->u, next, y);
  for (size_t i = 0; i < n; i++) {
    if (r[i] >= VARIABLES) return fail(it, "there is no variable %u", r[i]);
    values[i] = r[i] < INPUTS ? now->u[r[i]]
                : r[i] < INPUTS + OUTPUTS ? y[r[i] - INPUTS]
                                          : now->x[r[i] - INPUTS - OUTPUTS];
  }
  return fmi2OK;
}

STATUS NAME(fmi2SetReal)(fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2Real values[]) {
  Instance *it = c;
  for (size_t i = 0; i < n; i++) {
    if (r[i] < INPUTS)
      it->now.u[r[i]] = values[i];
    else if (r[i] >= INPUTS + OUTPUTS && r[i] < VARIABLES && it->now.phase <= INITIALISING)
      it->now.x[r[i] - INPUTS - OUTPUTS] = values[i];
    else
      return fail(it, r[i] < VARIABLES ? "%s cannot be set here" : "there is no variable %s",
                  r[i] < VARIABLES ? NAMES[r[i]] : "of this reference");
  }
  return fmi2OK;
}

/* Getting, setting and storing what a simulation remembers. */

STATUS NAME(fmi2GetFMUstate)(fmi2Component c, fmi2FMUstate *state) {
  if (!*state && !(*state = malloc(sizeof(Memory)))) return fail(c, "no memory");
  memcpy(*state, &((Instance *)c)->now, sizeof(Memory));
  return fmi2OK;
}

STATUS NAME(fmi2SetFMUstate)(fmi2Component c, fmi2FMUstate state) {
  if (!state) return fail(c, "no state is given");
  memcpy(&((Instance *)c)->now, state, sizeof(Memory));
  return fmi2OK;
}

STATUS NAME(fmi2FreeFMUstate)(fmi2Component c, fmi2FMUstate *state) {
  UNUSED(c);
  free(*state);
  *state = NULL;
  return fmi2OK;
}

STATUS NAME(fmi2SerializedFMUstateSize)(fmi2Component c, fmi2FMUstate state, size_t *size) {
  UNUSED(c), UNUSED(state);
  *size = sizeof(Memory);
  return fmi2OK;
}

STATUS NAME(fmi2SerializeFMUstate)(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
  if (size < sizeof(Memory)) return fail(c, "%u bytes hold no state", (unsigned)size);
  memcpy(bytes, state, sizeof(Memory));
  return fmi2OK;
}

STATUS NAME(fmi2DeSerializeFMUstate)(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state) {
  if (size != sizeof(Memory)) return fail(c, "%u bytes are no state", (unsigned)size);
  if (!*state && !(*state = malloc(sizeof(Memory)))) return fail(c, "no memory");
  memcpy(*state, bytes, sizeof(Memory));
  return fmi2OK;
}

/* What the model description says that the model has not: other types, derivatives, steps that wait. */

static fmi2Status none(const void *c, size_t n, const char *what) {
  return n ? fail(c, "the model has no %s", what) : fmi2OK;
}

#define NO_VARIABLES(type)                                                                                          \
  STATUS NAME(fmi2Get##type)(fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2##type values[]) {          \
    UNUSED(r), UNUSED(values);                                                                                      \
    return none(c, n, "variables of this type");                                                                    \
  }                                                                                                                 \
  STATUS NAME(fmi2Set##type)(fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2##type values[]) {    \
    UNUSED(r), UNUSED(values);                                                                                      \
    return none(c, n, "variables of this type");                                                                    \
  }
NO_VARIABLES(Integer)
NO_VARIABLES(Boolean)
NO_VARIABLES(String)

STATUS NAME(fmi2GetDirectionalDerivative)(fmi2Component c, const fmi2ValueReference unknown[], size_t n,
                                          const fmi2ValueReference known[], size_t m, const fmi2Real seed[],
                                          fmi2Real values[]) {
  UNUSED(unknown), UNUSED(known), UNUSED(m), UNUSED(seed), UNUSED(values);
  return none(c, n, "directional derivatives");
}

STATUS NAME(fmi2SetRealInputDerivatives)(fmi2Component c, const fmi2ValueReference r[], size_t n,
                                         const fmi2Integer order[], const fmi2Real values[]) {
  UNUSED(r), UNUSED(order), UNUSED(values);
  return none(c, n, "derivatives of inputs: they are held");
}

STATUS NAME(fmi2GetRealOutputDerivatives)(fmi2Component c, const fmi2ValueReference r[], size_t n,
                                          const fmi2Integer order[], fmi2Real values[]) {
  UNUSED(r), UNUSED(order), UNUSED(values);
  return none(c, n, "derivatives of outputs");
}

STATUS NAME(fmi2CancelStep)(fmi2Component c) { return fail(c, "a step is complete when fmi2DoStep returns"); }

#define NO_STATUS(function, type)                                                                                   \
  STATUS NAME(function)(fmi2Component c, const fmi2StatusKind kind, type *value) {                                    \
    UNUSED(c), UNUSED(kind), UNUSED(value);                                                                         \
    return fmi2Discard; /* only steps that wait have a status */                                                    \
  }
NO_STATUS(fmi2GetStatus, fmi2Status)
NO_STATUS(fmi2GetIntegerStatus, fmi2Integer)
NO_STATUS(fmi2GetStringStatus, fmi2String)

STATUS NAME(fmi2GetRealStatus)(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
  if (kind != fmi2LastSuccessfulTime) return fmi2Discard;
  *value = ((Instance *)c)->now.time;
  return fmi2OK;
}

STATUS NAME(fmi2GetBooleanStatus)(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value) {
  UNUSED(c);
  if (kind != fmi2Terminated) return fmi2Discard;
  *value = 0;
  return fmi2OK;
}
